"""What the brighter-fatter effect does to the size and shape of stars, and to shear."""
