"""Measurements on arrays in electrons, and the models that say what they should give."""
