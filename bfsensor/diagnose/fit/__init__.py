"""The joint fit of a baseline with effects: Gauss-Newton, random effects, likelihood profiles."""
