"""Statistics without physics: numpy and scipy only."""
