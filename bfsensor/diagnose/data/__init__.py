"""From exposures to channels: numbers with errors, and where each belongs."""
