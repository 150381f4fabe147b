"""Campaigns: folders of raw exposures, listed, checked and read."""
