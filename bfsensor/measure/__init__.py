"""Measurements on plain arrays: spots, flats, and the toy model."""
