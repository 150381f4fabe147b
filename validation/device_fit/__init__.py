"""Devices fitted to published measurements, and how often such fits cover the truth."""
