"""The errors stated for measured spots and flats cover the truth as often as they should."""
