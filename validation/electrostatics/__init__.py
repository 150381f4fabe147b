"""The potential of a device is the solution of Poisson's equation."""
