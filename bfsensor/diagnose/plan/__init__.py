"""What to record next, and what recordings not taken would show."""
