"""Explanations of a mismatch: effects of the library, or nonparametric terms where none fits."""
