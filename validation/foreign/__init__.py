"""Campaigns of recordings by a bench, an engine and laws of their own, to score the diagnosis with.

Nothing is imported from ``bfsensor`` or from ``validation.concealed``; formulae come from the
literature that each law cites.  The road, one module each:

    device          nominal devices, edge shifts by image charges, cards and baselines
    collection      charge arrives in steps while stored charge moves the edges
    layout, plan    amplifiers, overscans, files; what is recorded when
    law, laws*      the hooks of a law, and the laws by stage; law.LAWS is the register
    nuisances       what every real bench has and no diagnosis may take for physics
    bench           one exposure from lamp to codes
    raw_statistics, strength
                    projected SNR by common random numbers; amplitudes for a wanted SNR
    headers         vocabularies of headers, FITS
    campaign, __main__
                    folders, sets, truths, commitments; the command

README.md in this folder has the table of laws, the accuracy and the limits.
"""
