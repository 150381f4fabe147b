"""Shift of pixel boundaries near the edge of a sensor."""
