"""Compiled loops on plain arrays; imports numpy and numba only."""
