"""The command line: ``bfsensor COMMAND``, one file each."""
