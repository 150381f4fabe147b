"""Tests of residuals after a fit: scans and matched filters at one family-wise false-alarm rate."""
