"""Place of an amplifier in its file and on the sensor, from FITS sections.

Arrays are in readout order: x counts serial transfers from the output, y parallel ones.  A
reversed DATASEC, such as [256:129,1:256], means that the file stores an axis against the readout,
a reversed DETSEC that the sensor's coordinate runs against the readout.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bfsensor.errors import RecordingError

Box = tuple[slice, slice]
"""Slices of the rows and the columns of an image."""


@dataclass(frozen=True)
class Section:
    """A FITS section, '[x1:x2,y1:y2]', as slices from 0, with flags for reversed axes."""

    rows: slice
    columns: slice
    flip_x: bool = False
    flip_y: bool = False

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.rows.stop - self.rows.start, self.columns.stop - self.columns.start


def parse_section(text: Any, where: str) -> Section:
    """Read a FITS section, whose axes may be reversed.

    Parameters
    ----------
    text : str
        Section such as '[1:128,1:256]', counted from 1, ends included, x first.
    where : str
        Name of file and keyword, for errors.

    Returns
    -------
    section : Section
        The section as slices; reversed axes have their flag set.

    Raises
    ------
    RecordingError
        The text is not of that form, or a number is below 1.

    Examples
    --------
    >>> found = parse_section("[256:129,1:256]", "DETSEC")
    >>> found.columns, found.flip_x, found.flip_y
    (slice(128, 256, None), True, False)
    """
    match = re.fullmatch(r"\s*\[\s*(\d+):(\d+)\s*,\s*(\d+):(\d+)\s*\]\s*", str(text))
    if match is None:
        raise RecordingError(
            f"{where} = {text!r} is not like '[1:512,1:2000]', first and last column, then "
            "first and last row"
        )
    x1, x2, y1, y2 = (int(number) for number in match.groups())
    if min(x1, x2, y1, y2) < 1:
        raise RecordingError(
            f"{where} = {text!r} begins below 1, where FITS counts pixels from"
        )
    return Section(
        slice(min(y1, y2) - 1, max(y1, y2)), slice(min(x1, x2) - 1, max(x1, x2)),
        x1 > x2, y1 > y2,
    )  # fmt: skip


@dataclass(frozen=True)
class AmplifierLayout:
    """Place of an amplifier's pixels in the file and on the sensor, with gain and noise.

    Attributes
    ----------
    name : str
        EXTNAME, or the name given in campaign.yaml.
    hdu : int
        Index of the HDU that holds the image, 0 for the primary one.
    stored : tuple of int
        Shape (ny, nx) of the stored image.
    window : (slice, slice)
        Rows and columns of the stored image that belong to this amplifier.
    stored_flip_x, stored_flip_y : bool
        True where the file stores the axis against the readout.
    data : (slice, slice)
        Image section (DATASEC), in readout order within the window.
    bias : (slice, slice) or None
        Overscan that BIASSEC names, in readout order within the window; None without one.
    origin : tuple of int or None
        Sensor coordinates (x, y) of the corner of lowest x and y, from 0, in pixels as read
        (binned); None where DETSEC is not given.
    flip_x, flip_y : bool
        True where the sensor's coordinate falls in readout order.
    on_sensor : tuple of int or None
        Rows and columns that DETSEC spans, in pixels as read; they differ from those of
        ``data`` where the header is wrong.
    binning : tuple of int
        Binning in x and y (CCDSUM); (1, 1) where DETSEC is not given.
    bias_problem : str
        Why BIASSEC cannot be used; '' where it can, or is not given.
    gain, noise, saturation : float or None
        Gain [e-/ADU], read noise [e-] and saturation level [ADU]; None where neither header
        nor campaign.yaml has one.
    """

    name: str
    hdu: int
    stored: tuple[int, int]
    window: Box
    stored_flip_x: bool
    stored_flip_y: bool
    data: Box
    bias: Box | None
    origin: tuple[int, int] | None
    flip_x: bool
    flip_y: bool
    on_sensor: tuple[int, int] | None
    binning: tuple[int, int] = (1, 1)
    bias_problem: str = ""
    gain: float | None = None
    noise: float | None = None
    saturation: float | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the image section."""
        rows, columns = self.data
        return rows.stop - rows.start, columns.stop - columns.start

    @property
    def raw_shape(self) -> tuple[int, int]:
        """Rows and columns with prescan and overscan."""
        rows, columns = self.window
        return rows.stop - rows.start, columns.stop - columns.start

    @property
    def serial_overscan(self) -> int:
        """Columns read after the image's last one."""
        return self.raw_shape[1] - self.data[1].stop

    @property
    def parallel_overscan(self) -> int:
        """Rows read after the image's last one."""
        return self.raw_shape[0] - self.data[0].stop

    @property
    def prescan(self) -> int:
        """Columns read before the image's first one."""
        return int(self.data[1].start)

    def geometry(self) -> tuple[Any, ...]:
        """Attributes that must agree between exposures: all but gain, noise and saturation."""
        return tuple(
            str(getattr(self, name)) for name in self.__dataclass_fields__
        )[:-3]  # fmt: skip

    def footprint(self) -> tuple[int, int, int, int] | None:
        """First x, last x + 1, first y, last y + 1 on the sensor; None without DETSEC."""
        if self.origin is None:
            return None
        (x, y), (ny, nx) = self.origin, self.shape
        return x, x + nx, y, y + ny


def layout_of(
    where: str, name: str, hdu: int, stored: tuple[int, int], header: Mapping[str, Any]
) -> AmplifierLayout:
    """Find one amplifier's place from DATASEC, BIASSEC, DETSEC and CCDSUM.

    A blank section counts as not given; without DATASEC the whole image is data.  A BIASSEC
    that cannot be used is no error, because trimmed images often still have one: the reason is
    kept as ``bias_problem``, and the level of the overscan is not subtracted.

    Parameters
    ----------
    where : str
        Name of the file or amplifier, for errors.
    name, hdu, stored
        As in :class:`AmplifierLayout`.
    header : mapping
        Sections by keyword; WINDOW is the amplifier's section of the stored image, from
        campaign.yaml.

    Returns
    -------
    layout : AmplifierLayout
        The place, without gain, noise and saturation.

    Raises
    ------
    RecordingError
        A section other than BIASSEC cannot be read or leaves the image.  The message says
        where it would fit with x and y exchanged.
    """
    window = Section(slice(0, stored[0]), slice(0, stored[1]))
    window = _section_in("WINDOW", header, where, stored, window) or window
    data = _section_in("DATASEC", header, where, stored, window) or window
    bias, problem = None, ""
    try:
        bias = _section_in("BIASSEC", header, where, stored, window)
    except RecordingError as error:
        problem = str(error).removeprefix(f"{where}: ")

    def readout(section: Section) -> Box:
        return (
            _seen_from(section.rows, window.rows, data.flip_y),
            _seen_from(section.columns, window.columns, data.flip_x),
        )

    layout = AmplifierLayout(
        name=name, hdu=hdu, stored=stored, window=(window.rows, window.columns),
        stored_flip_x=data.flip_x, stored_flip_y=data.flip_y, data=readout(data),
        bias=None if bias is None else readout(bias), origin=None, flip_x=False, flip_y=False,
        on_sensor=None, bias_problem=problem,
    )  # fmt: skip
    if not header.get("DETSEC"):
        return layout
    place = parse_section(header["DETSEC"], f"{where}: DETSEC")
    bx, by = _binning(header.get("CCDSUM"), where)
    # Most cameras count unbinned pixels in DETSEC, some binned ones: the shape decides.
    if place.shape == layout.shape:
        bx_place, by_place = 1, 1
    else:
        bx_place, by_place = bx, by
    ny, nx = place.shape
    return replace(
        layout,
        origin=(place.columns.start // bx_place, place.rows.start // by_place),
        flip_x=place.flip_x, flip_y=place.flip_y,
        on_sensor=(-(-ny // by_place), -(-nx // bx_place)), binning=(bx, by),
    )  # fmt: skip


def to_sensor(layout: AmplifierLayout, image: NDArray[Any]) -> NDArray[Any]:
    """Turn an image from readout order into sensor coordinates, or back; a view."""
    return image[:: -1 if layout.flip_y else 1, :: -1 if layout.flip_x else 1]


def overlaps(layouts: Sequence[AmplifierLayout]) -> list[tuple[str, str]]:
    """Pairs of amplifiers whose DETSEC share pixels of the sensor.

    Examples
    --------
    >>> header = {"DETSEC": "[1:4,1:4]"}
    >>> overlaps([layout_of("x", n, 1, (4, 4), header) for n in ("A", "B")])
    [('A', 'B')]
    """
    found = []
    for k, one in enumerate(layouts):
        for other in layouts[k + 1 :]:
            a, b = one.footprint(), other.footprint()
            if a is None or b is None:
                continue
            if max(a[0], b[0]) < min(a[1], b[1]) and max(a[2], b[2]) < min(a[3], b[3]):
                found.append((one.name, other.name))
    return found


def _seen_from(part: slice, whole: slice, flipped: bool) -> slice:
    """Slice within a window, counted from the output's end of the axis."""
    if flipped:
        return slice(whole.stop - part.stop, whole.stop - part.start)
    return slice(part.start - whole.start, part.stop - whole.start)


def _section_in(
    card: str,
    cards: Mapping[str, Any],
    where: str,
    stored: tuple[int, int],
    window: Section,
) -> Section | None:
    """Section of a keyword, checked to lie in the image and in the amplifier's window."""
    text = cards.get(card)
    if not str(text or "").strip():
        return None
    found = parse_section(text, f"{where}: {card}")
    _inside(found, stored, f"{where}: {card} = {text!r}")
    if not _within(found, window):
        rows, columns = window.rows, window.columns
        raise RecordingError(
            f"{where}: {card} = {text!r} leaves the amplifier's window "
            f"[{columns.start + 1}:{columns.stop},{rows.start + 1}:{rows.stop}]"
        )
    return found


def _within(part: Section, whole: Section) -> bool:
    return bool(
        whole.rows.start <= part.rows.start
        and part.rows.stop <= whole.rows.stop
        and whole.columns.start <= part.columns.start
        and part.columns.stop <= whole.columns.stop
    )


def _inside(section: Section, stored: tuple[int, int], where: str) -> None:
    """Refuse a section that leaves the stored image."""
    ny, nx = stored
    if section.rows.stop <= ny and section.columns.stop <= nx:
        return
    exchanged = section.rows.stop <= nx and section.columns.stop <= ny
    raise RecordingError(
        f"{where} leaves the image, {nx} x {ny} pixels"
        + ("; with x and y exchanged it would fit" if exchanged else "")
    )


def _binning(text: Any, where: str) -> tuple[int, int]:
    """Binning in x and y from CCDSUM, such as '2 2'; 1 in both without it."""
    if text is None:
        return 1, 1
    try:
        bx, by = (int(float(word)) for word in np.atleast_1d(str(text).split()))
    except ValueError:
        raise RecordingError(
            f"{where}: CCDSUM = {text!r} is not like '1 1', the binning in x and in y"
        ) from None
    if min(bx, by) < 1:
        raise RecordingError(f"{where}: CCDSUM = {text!r} must be above 0")
    return bx, by
