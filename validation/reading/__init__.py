"""Broken recordings are set aside by name, never lost in silence."""
