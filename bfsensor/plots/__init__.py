"""Figures: functions that draw plain arrays or results into axes."""
