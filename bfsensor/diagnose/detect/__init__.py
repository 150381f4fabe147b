"""Whether and where something is left: scans and matched filters at one false-alarm rate."""
