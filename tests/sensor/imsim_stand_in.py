"""Types of GalSim's configuration that call a sensor in the order in which imSim calls it.

imSim needs LSST's software; these stand-ins need GalSim alone.  ``imsim_structure.yaml`` has the
structure of imSim's configuration and names them.  Tests with a checkout of imSim are in
``test_imsim_checkout.py``.
"""

from __future__ import annotations

import pickle
from pathlib import Path

import galsim
import numpy as np
from galsim.config import (
    ExtraOutputBuilder,
    GetAllParams,
    InputLoader,
    OutputBuilder,
    ParseValue,
    RegisterExtraOutput,
    RegisterImageType,
    RegisterInputType,
    RegisterOutputType,
    RegisterStampType,
    RegisterValueType,
    StampBuilder,
)
from galsim.config.image_scattered import ScatteredImageBuilder

VENDORS = {"R01_S00": "ITL", "R22_S11": "E2V"}
RING_CENTRES = {"R01_S00": (-300.0, -310.0), "R22_S11": (360.0, -250.0)}
WELL = 1.2e5
"""Full well of the readout [e-], below those of both sensors, which are above 1.7e5."""


class Ccd(OutputBuilder):
    """One detector a file: its name becomes known to the images, as LSST_CCD does it."""

    def setup(self, config, base, file_num, logger):
        super().setup(config, base, file_num, logger)
        number = ParseValue(config, "det_num", base, int)[0]
        base["det_num"] = number
        base["det_name"] = config["only_dets"][number]
        for key in ("det_name", "det_num"):
            if key not in galsim.config.eval_base_variables:
                galsim.config.eval_base_variables.append(key)

    def getNFiles(self, config, base, logger=None):
        return len(config["only_dets"])

    def buildImages(self, config, base, file_num, image_num, obj_num, ignore, logger):
        ignore += [
            "file_name",
            "dir",
            "nfiles",
            "det_num",
            "only_dets",
            "camera",
            "readout",
        ]
        galsim.config.CheckAllParams(config, ignore=ignore)
        image = galsim.config.BuildImage(base, image_num, obj_num, logger=logger)
        sensor = base["sensor"]
        image.header = galsim.FitsHeader({
            "DET_NAME": base["det_name"], "SENSOR": str(sensor), "RINGX": sensor.treering_center.x,
            "SPILLED": getattr(sensor, "diagnostics", {}).get("spilled", 0.0),
        })  # fmt: skip
        return [image]


class Objects(ScatteredImageBuilder):
    """Objects in batches on stamps of their own, with a checkpoint after each batch."""

    def setup(self, config, base, image_num, obj_num, ignore, logger):
        own = ["det_name", "camera", "nbatch", "boresight"]
        sizes = super().setup(config, base, image_num, obj_num, [*ignore, *own], logger)
        self.det_name = ParseValue(config, "det_name", base, str)[0]
        self.nbatch = ParseValue(config, "nbatch", base, int)[0]
        sensor = config.get("sensor", {})
        if sensor.get("type") == "Silicon" and sensor.get("name") is None:
            sensor["name"] = f"lsst_{VENDORS[self.det_name].lower()}_50_8"
        try:
            kind = "stand_in_checkpoint"
            self.checkpoint = galsim.config.GetInputObj(kind, config, base, "Objects")
        except galsim.GalSimConfigError:
            self.checkpoint = None
        return sizes

    def buildImage(self, config, base, image_num, obj_num, logger):
        image, first = base["current_image"], obj_num
        if self.checkpoint is not None and (saved := self.checkpoint.load(self.det_name)):
            stored, first = saved
            image.array[...] = stored.array
        left = self.nobjects - (first - obj_num)
        for batch in range(self.nbatch):
            start = first + left * batch // self.nbatch
            end = first + left * (batch + 1) // self.nbatch
            stamps, _ = galsim.config.BuildStamps(
                end - start, base, logger=logger, obj_num=start, do_noise=False
            )
            base["index_key"] = "image_num"
            for stamp in stamps:
                bounds = stamp.bounds & image.bounds
                if bounds.isDefined():
                    image[bounds] += stamp[bounds]
            if self.checkpoint is not None:
                self.checkpoint.save(self.det_name, (image, end))
        return image, 0.0


class Pooled(Objects):
    """Photons of all objects in pools, accumulated on the whole image with ``resume``."""

    subbatches = 3

    def buildImage(self, config, base, image_num, obj_num, logger):
        image, first = base["current_image"], 0
        if self.checkpoint is not None and (saved := self.checkpoint.load(self.det_name)):
            image, first = saved
        rng = galsim.config.GetRNG(config, base, logger, "Pooled")
        sensor = base["sensor"]
        sensor.updateRNG(rng)
        # Pools after a restart must not repeat the photons of those before it.
        base["_pool_rng"] = galsim.BaseDeviate(int(rng.raw()) + first)
        flux = int(ParseValue(base["stamp"], "pool_flux", base, float)[0])
        for batch in range(first, self.nbatch):
            base["index_key"] = "image_num"
            base["_pool_flux"] = (
                flux * (batch + 1) // self.nbatch - flux * batch // self.nbatch
            )
            for part in range(self.subbatches):
                numbers = range(obj_num + part, obj_num + self.nobjects, self.subbatches)
                arrays = [
                    galsim.config.BuildStamp(
                        base, number, xsize=0, ysize=0, do_noise=False, logger=logger
                    )[0].photons
                    for number in numbers
                ]
                photons = galsim.PhotonArray.concatenate(arrays)
                resume = batch > first or part > 0
                if isinstance(sensor, galsim.SiliconSensor):
                    sensor.accumulate(photons, image, resume=resume, recalc=part == 0)
                else:
                    sensor.accumulate(photons, image, resume=resume)
            if self.checkpoint is not None:
                self.checkpoint.save(self.det_name, (image, batch + 1))
        base["index_key"] = "image_num"
        return image, 0.0


class NoSensor(galsim.Sensor):
    """Sensor that collects nothing: the stamps of pools only make photons."""

    def accumulate(self, photons, image, orig_center=None, resume=False):
        return 0.0


class Photons(StampBuilder):
    """Stamp whose photons stay with it, in the coordinates of the image."""

    def setup(self, config, base, xsize, ysize, ignore, logger):
        return super().setup(config, base, xsize, ysize, [*ignore, "pool_flux"], logger)

    def draw(self, prof, image, method, offset, config, base, logger):
        flux = base["_pool_flux"]
        prof.withFlux(flux).drawImage(
            image=image, method="phot", n_photons=flux, poisson_flux=False,
            offset=offset, wcs=base["wcs"].local(image_pos=base["image_pos"]),
            rng=base["_pool_rng"], sensor=NoSensor(), add_to_image=True, save_photons=True,
        )  # fmt: skip
        centre = base["stamp_center"]
        image.photons.x += centre.x
        image.photons.y += centre.y
        return image


class Interrupted(Exception):
    """The run stops here, as a job that is killed."""


class Checkpoint:
    """Keeps data by name in one file; ``stop_after`` ends the run after as many."""

    _req_params = {"file_name": str}  # noqa: RUF012
    _opt_params = {"stop_after": int}  # noqa: RUF012

    def __init__(self, file_name, stop_after=None):
        self.path, self.left = Path(file_name), stop_after

    def save(self, name, data):
        self.path.write_bytes(pickle.dumps({**self._stored(), name: data}))
        if self.left is not None:
            self.left -= 1
            if self.left == 0:
                raise Interrupted

    def load(self, name):
        return self._stored().get(name)

    def _stored(self):
        return pickle.loads(self.path.read_bytes()) if self.path.exists() else {}


def bleed(image, well, *, midline):
    """Move charge above the well to the nearest room along columns; E2V's halves are apart."""
    out = image.copy()
    middle = out.shape[0] // 2
    for part in (out[:middle], out[middle:]) if midline else (out,):
        for column in part.T:
            for y in np.flatnonzero(column > well):
                excess, column[y] = column[y] - well, well
                order = np.argsort(np.abs(np.arange(len(column)) - y), kind="stable")
                for room in order:
                    moved = min(excess, max(well - column[room], 0.0))
                    column[room] += moved
                    excess -= moved
    return out


class Readout(ExtraOutputBuilder):
    """Readout that moves charge above the full well along its column, in the finished image."""

    def finalize(self, config, base, main_data, logger):
        params = GetAllParams(
            config, base, opt={"full_well": float}, ignore=["file_name", "dir"]
        )[0]
        image = main_data[0]
        midline = VENDORS[image.header["DET_NAME"]] == "E2V"
        array = bleed(image.array, params.get("full_well", WELL), midline=midline)
        return [galsim.Image(array)]


def ring_centre(config, base, value_type):
    """Centre of the rings of a detector."""
    kwargs, safe = GetAllParams(config, base, req={"det_name": str})
    return galsim.PositionD(*RING_CENTRES[kwargs["det_name"]]), safe


def ring_function(config, base, value_type):
    """Radial shift of the rings of a detector."""
    kwargs, safe = GetAllParams(config, base, req={"det_name": str})
    period = 40.0 if VENDORS[kwargs["det_name"]] == "ITL" else 70.0
    return galsim.SiliconSensor.simple_treerings(0.1, period, r_max=900.0), safe


RegisterOutputType("StandInCcd", Ccd())
RegisterImageType("StandInImage", Objects())
RegisterImageType("StandInPooledImage", Pooled())
RegisterStampType("StandInPhotons", Photons())
RegisterInputType("stand_in_checkpoint", InputLoader(Checkpoint))
RegisterExtraOutput("readout", Readout())
RegisterValueType("StandInRingCentre", ring_centre, [galsim.PositionD])
RegisterValueType("StandInRingFunction", ring_function, [galsim.LookupTable])
