"""Predictions of every channel from a baseline and effects."""
