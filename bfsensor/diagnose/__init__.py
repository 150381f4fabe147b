"""Recordings against prediction: channels, mismatch, report."""
