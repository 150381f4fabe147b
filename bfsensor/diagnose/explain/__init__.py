"""What explains what is left: effects of the library, or nonparametric terms."""
