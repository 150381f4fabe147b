"""Mutants: one line of the package is changed at a time, and the tests are to notice."""
