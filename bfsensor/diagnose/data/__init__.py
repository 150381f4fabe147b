"""Measurement of a campaign's exposures: channels of values with errors and coordinates."""
