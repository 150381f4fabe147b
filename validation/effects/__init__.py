"""Each effect's prediction agrees with what the effect does to pixels."""
