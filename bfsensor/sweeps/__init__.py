"""Independent points of work on any executor, and sweeps of a device over its quantities."""
