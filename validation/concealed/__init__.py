"""Makers of concealed recordings: campaigns of a virtual sensor with something left out.

``python -m validation.concealed make FOLDER`` writes campaigns that look like real recordings
(raw frames per amplifier with overscans, a manifest, the device's card, the baseline's edge
shifts) together with a truth that can be kept elsewhere and is committed to by its hash.
``validation.concealed.arrays.iterate_exposures`` gives the same exposures in memory.

The road, one module each; nothing is imported from ``bfsensor``:

    card, electrostatics   nominal device, scatter of real ones; edge shifts by image charges
    plan                   sizes S, M, L; which exposures, when, at which condition
    scene                  light: lamp walk, gradient, spots with dithers, light along edges
    collect                charge arrives in steps while stored charge moves the edges
    readout                amplifier frames in readout order, noise, converter
    effect, effects_*      31 classes that a baseline may leave out, by stage
    outside                mismatches that no class describes
    library                all of them; random draws
    sensor                 one chip: light to codes
    campaign, __main__     folders, truth, commitment, command line

and, for the challenge that such campaigns make:

    submit                 reports made once, by subprocess, fixed by hash before truths open
    conventions            one table: how a truth and a report are held against one another
    score, tally, misses   one campaign; many beside the goals; what went wrong, in words
    opening, rows          truths opened; results

Every campaign, nulls too, has: a device scattered by its card's spread, gains (3 %), read noise
(4 %), offsets, 0.05 e- row noise, 0.3 % pixel response, 3e-4 pixel edge scatter, illumination
gradients, a lamp that walks by 2e-4 per exposure and a monitor that errs by 2e-4, dark current,
spots at random 1/8-pixel dithers with 2 % scatter in flux, spot widths off by 2 % in x and y.

Not modelled: a field edge at the sensor's rim (collection continues periodically), shifts
beyond 10 pixels (edges there stand still, in the baseline too), bending of an edge within one
pixel, the second order where two moved edges meet in a corner; in nulls no spot wings, cosmic
rays or hot columns, and spots of the same width at all conditions.
"""
