"""Device parameters from measurements."""
