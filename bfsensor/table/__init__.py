"""Distortion tables: planned, solved level by level, assessed, read and written in three formats."""
