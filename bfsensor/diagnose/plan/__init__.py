"""Recordings to take next, and predictions for exposures that were not taken."""
