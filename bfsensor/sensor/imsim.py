"""imSim's configuration: the sensor of each detector, and which of two full wells acts.

imSim draws one detector an image and names it ``det_name``; for ``type: Silicon`` alone it
picks the table of the detector's vendor.  Here a sensor without ``name`` takes table and
temperature from a :class:`bfsensor.sensor.focal_plane.FocalPlane`.  imSim's ``output.readout``
moves charge above the full well along its column after the exposure; where it is asked for, a
sensor does not spill.  Nothing of imSim is imported.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from galsim.config.value import ParseValue
from galsim.errors import GalSimConfigError

from bfsensor.errors import SensorError
from bfsensor.sensor.focal_plane import CAMERAS, FocalPlane

KEYS = ("det_name", "focal_plane")
"""Items of a sensor's configuration that are answered here."""

_SILICON = {"ITL": "lsst_itl_50_8", "E2V": "lsst_e2v_50_8"}
"""GalSim's tables by vendor, for sensors that read those."""


def choose_options(
    sensor: type, config: Mapping[str, Any], base: Mapping[str, Any], logger: Any
) -> dict[str, Any]:
    """Complete the configuration of a sensor by what its detector and the readout ask for.

    Parameters
    ----------
    sensor : type
        Class of the sensor, with GalSim's ``_opt_params``.
    config : mapping
        Configuration of the sensor.
    base : mapping
        The whole configuration.
    logger : logging.Logger or galsim.config.LoggerWrapper, optional
        Where the choice is noted.

    Returns
    -------
    config : dict
        The configuration with ``name`` and the options of the detector, which those that it gave
        precede, and without ``det_name`` and ``focal_plane``.

    Raises
    ------
    galsim.GalSimConfigError
        ``name`` is given beside ``det_name`` or ``focal_plane``, or ``focal_plane`` where no
        detector is named.
    SensorError
        The focal plane has no table for the detector, or an option that the sensor does not take.
    """
    out = {key: value for key, value in config.items() if key not in KEYS}
    detector = None
    if "name" in config:
        given = [key for key in KEYS if key in config]
        if given:
            raise GalSimConfigError(
                f"image.sensor gives name and {' and '.join(given)}: give the table by name, or "
                "let the detector choose it"
            )
    else:
        detector = _detector(config, base)
        if detector is not None:
            out = {**_detector_options(sensor, detector, config, base), **out}
        elif "focal_plane" in config:
            raise GalSimConfigError(
                "image.sensor.focal_plane needs a detector: give det_name in image.sensor or image"
            )
    if "full_well" in sensor._opt_params and _readout_bleeds(base):  # type: ignore[attr-defined]
        if "full_well" not in config:
            out["full_well"] = math.inf
        elif not math.isinf(ParseValue(dict(config), "full_well", base, float)[0]):
            _note(
                logger, "warning", "image.sensor.full_well and output.readout both act: charge "
                "that spilled in the sensor is moved again by the readout; give full_well: .inf "
                "in one of them",
            )  # fmt: skip
    if detector is not None:
        well = (
            "; full well left to output.readout" if out.get("full_well") == math.inf else ""
        )
        _note(logger, "info", f"detector {detector}: table {out['name']}{well}")
    return out


def _note(logger: Any, level: str, text: str) -> None:
    """Write a line to a logger, if there is one."""
    if logger is not None:
        getattr(logger, level)(text)


def _text(config: Any, key: str, base: Any) -> str:
    """Evaluate an item that is a text."""
    return str(ParseValue(config, key, base, str)[0])


def _detector(config: Mapping[str, Any], base: Mapping[str, Any]) -> str | None:
    """Name of the detector: of the sensor's item, the image's, or the one that the output set."""
    image = base.get("image")
    for field in (config, image):
        if isinstance(field, Mapping) and "det_name" in field:
            return _text(field, "det_name", base)
    name = base.get("det_name")
    return None if name is None else str(name)


def _focal_plane(config: Mapping[str, Any], base: Mapping[str, Any]) -> FocalPlane:
    """Read the focal plane that the sensor names, or that of the image's or output's camera."""
    if "focal_plane" in config:
        return FocalPlane.read(_text(config, "focal_plane", base))
    camera = "LsstCamSim"  # imSim's default
    for field in (base.get("image"), base.get("output")):
        if isinstance(field, Mapping) and "camera" in field:
            camera = _text(field, "camera", base)
            break
    if camera not in CAMERAS:
        raise SensorError(
            f"the camera {camera!r} has no built-in focal plane ({', '.join(CAMERAS)}): give a file "
            "as focal_plane in image.sensor, or name"
        )
    return FocalPlane.read(camera)


def _detector_options(
    sensor: Any, detector: str, config: Mapping[str, Any], base: Mapping[str, Any]
) -> dict[str, Any]:
    """Options of the sensor of a detector, for our tables or for GalSim's."""
    plane = _focal_plane(config, base)
    options = plane.options(detector)
    if "full_well" not in sensor._opt_params:
        vendor = plane.vendor(detector)
        if vendor not in _SILICON:
            raise SensorError(
                f"{plane.path.name}: {detector}: vendor = {vendor!r} is none of "
                f"{', '.join(_SILICON)}, which choose GalSim's table; give name"
            )
        options["name"] = _SILICON[vendor]
    wrong = sorted(set(options) - set(sensor._opt_params))
    if wrong:
        raise SensorError(
            f"{plane.path.name}: {detector}: {', '.join(wrong)} is no option of {sensor.__name__}"
        )
    return options


def _readout_bleeds(base: Mapping[str, Any]) -> bool:
    """Whether imSim's readout is asked for, with a full well that is not infinite."""
    output = base.get("output")
    readout = output.get("readout") if isinstance(output, Mapping) else None
    if not isinstance(readout, Mapping) or not readout:
        return False
    if "full_well" not in readout:
        return True
    return not math.isinf(ParseValue(readout, "full_well", base, float)[0])
