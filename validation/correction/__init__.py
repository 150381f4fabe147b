"""What corrections in LSST's formats leave of an effect that they know exactly."""
