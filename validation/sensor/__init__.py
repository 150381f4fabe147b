"""Sensors draw what the distortion table says, and what the direct simulation gives."""
