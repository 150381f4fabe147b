"""What explains a mismatch: missing physics, device parameters, ties, effects of no known class."""
