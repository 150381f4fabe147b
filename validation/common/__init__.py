"""What every check shares: results with their header, and the virtual sensor as a recording."""
