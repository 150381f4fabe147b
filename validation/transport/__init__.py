"""Electrons drift and diffuse as the field and Einstein's relation say."""
