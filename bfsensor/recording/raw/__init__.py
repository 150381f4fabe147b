"""Raw FITS files: keywords, sections, masks, pixels."""
