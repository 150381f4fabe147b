"""Growth of spots with flux at the settings of the seed paper."""
