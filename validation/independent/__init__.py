"""Campaigns of an independent bench: the claim, its rows by ``validation.concealed``."""
