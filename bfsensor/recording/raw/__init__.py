"""Raw FITS files: keywords, sections, overscans, masks, pixels."""

from typing import TYPE_CHECKING

from bfsensor._lazy import lazy_names

if TYPE_CHECKING:
    from bfsensor.recording.raw.headers import FileScan, scan_file
    from bfsensor.recording.raw.images import AmplifierImage, read_images
    from bfsensor.recording.raw.masks import read_masks
    from bfsensor.recording.raw.overscan import find_overscan, subtract_overscan
    from bfsensor.recording.raw.pixels import AmplifierPixels, read_pixels
    from bfsensor.recording.raw.sections import AmplifierLayout, Section
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "headers": ["FileScan", "scan_file"],
            "images": ["AmplifierImage", "read_images"],
            "masks": ["read_masks"],
            "overscan": ["find_overscan", "subtract_overscan"],
            "pixels": ["AmplifierPixels", "read_pixels"],
            "sections": ["AmplifierLayout", "Section"],
        },
    )

__all__ = [
    "AmplifierImage",
    "AmplifierLayout",
    "AmplifierPixels",
    "FileScan",
    "Section",
    "find_overscan",
    "read_images",
    "read_masks",
    "read_pixels",
    "scan_file",
    "subtract_overscan",
]
