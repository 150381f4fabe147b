"""Detection of what a fit leaves: scans and matched filters at one family-wise false-alarm rate."""
