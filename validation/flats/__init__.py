"""Covariances of flats follow from pixel areas, and agree with measured ones."""
