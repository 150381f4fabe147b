"""Recordings of real sensors, diagnosed."""
