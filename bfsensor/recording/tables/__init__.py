"""Recordings that others reduced: tables of a_ij, covariances, spots, settings."""
