"""The full well of a device beside measured saturation levels."""
