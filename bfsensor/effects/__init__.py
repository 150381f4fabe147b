"""Effects that a baseline may leave out: one file each, on plain arrays."""
