"""imSim's own code on our sensors: the files of a checkout that run without LSST's software.

``IMSIM_DIR`` names the checkout.  Its modules for images, pools, tree rings, bleed trails, readout
and checkpoints are imported as they are; what they import of LSST's software and of imSim's
optics is replaced by the little that they use of it.
"""

from __future__ import annotations

import importlib
import logging
import os
import sys
import types
from dataclasses import dataclass
from enum import Enum, auto
from pathlib import Path

import galsim
import numpy as np
import pytest
import yaml

import bfsensor
from bfsensor.sensor.imsim import choose_options
from tests.sensor.imsim_stand_in import NoSensor

IMSIM = Path(os.environ.get("IMSIM_DIR", "/nonexistent"))

pytestmark = pytest.mark.skipif(
    not (IMSIM / "imsim" / "lsst_image.py").is_file(),
    reason="IMSIM_DIR names no checkout of imSim",
)

VENDORS = {"R01_S00": "ITL", "R22_S11": "E2V"}
TABLES = {"R01_S00": "itl_sta3800c", "R22_S11": "e2v_ccd250"}
WELL = 1.2e5
"""Full well that the stand-in of the camera gives the readout [e-]."""


class Detector:
    """What imSim asks of a detector of LSST's camera, and of its one amplifier."""

    gain, read_noise, bias_level, full_well, xtalk = 1.0, 0.0, 0.0, WELL, None
    raw_flip_x = raw_flip_y = False

    def __init__(self, name, size=64):
        self.name = name
        self.bounds = galsim.BoundsI(1, size, 1, size)
        self.raw_bounds = self.raw_data_bounds = self.bounds

    def values(self):
        return [self]

    def getName(self):
        return self.name

    def getPhysicalType(self):
        return VENDORS[self.name]

    def getSerial(self):
        return f"{VENDORS[self.name]}-1"


class Camera(dict):
    """Detectors by name."""

    def __init__(self, camera_class="LsstCamSim", bias_levels_file=None):
        super().__init__({name: Detector(name) for name in VENDORS})


class Mode(Enum):
    """Ways in which imSim draws an object."""

    FFT = auto()
    PHOT = auto()
    FAINT = auto()


@dataclass
class ObjectInfo:
    """Number of photons of an object, and how it is drawn."""

    index: int
    phot_flux: float
    mode: Mode


def build_obj(stamp, base, logger):
    return ObjectInfo(base["obj_num"], int(stamp["pool_flux"]), Mode.PHOT)


class Photons(galsim.config.StampBuilder):
    """Stamp that gives the photons of its object."""

    def setup(self, config, base, xsize, ysize, ignore, logger):
        return super().setup(config, base, xsize, ysize, [*ignore, "pool_flux"], logger)

    def draw(self, prof, image, method, offset, config, base, logger):
        flux = base["_objects"][base["obj_num"]].phot_flux
        # Another part of the light in each pool.
        rng = base.setdefault("_pool_rng", galsim.BaseDeviate(8128))
        prof.withFlux(flux).drawImage(
            image=image, method="phot", n_photons=flux, poisson_flux=False, offset=offset,
            wcs=base["wcs"].local(image_pos=base["image_pos"]), rng=rng, sensor=NoSensor(),
            add_to_image=True, save_photons=True,
        )  # fmt: skip
        image.photons.x += base["stamp_center"].x
        image.photons.y += base["stamp_center"].y
        return image


def stand_in(monkeypatch, name, **content):
    """Put a module with some content into the place of one that cannot be imported."""
    module = types.ModuleType(name)
    module.__dict__.update(content)
    monkeypatch.setitem(sys.modules, name, module)
    parent, _, last = name.rpartition(".")
    if parent in sys.modules:
        monkeypatch.setattr(sys.modules[parent], last, module, raising=False)
    return module


@pytest.fixture
def imsim(monkeypatch):
    """Importer of imSim's modules; everything is as before when the test ends."""
    registries = (
        galsim.config.image.valid_image_types, galsim.config.stamp.valid_stamp_types,
        galsim.config.input.valid_input_types, galsim.config.extra.valid_extra_outputs,
        galsim.config.value.valid_value_types, galsim.config.process.valid_templates,
    )  # fmt: skip
    saved = [dict(registry) for registry in registries]
    stand_in(monkeypatch, "imsim", __path__=[str(IMSIM / "imsim")])
    nothing = dict.fromkeys(
        ("SkyGradient", "CCD_Fringing", "Vignetting", "BatoidWCSBuilder", "load_telescope",
         "ignore_erfa_warnings")
    )  # fmt: skip
    nothing["ignore_erfa_warnings"] = lambda function: function
    camera = Camera()
    nothing.update(
        get_camera=lambda name: camera, Camera=Camera, data_dir=str(IMSIM / "data"),
        ProcessingMode=Mode, ObjectInfo=ObjectInfo, build_obj=build_obj, __version__="0",
    )  # fmt: skip
    for name in (
        "sky_model", "camera", "vignetting", "meta_data", "stamp", "batoid_wcs",
        "telescope_loader", "utils", "_version",
    ):  # fmt: skip
        stand_in(monkeypatch, f"imsim.{name}", **nothing)
    for name in ("eups", "lsst", "lsst.afw", "lsst.afw.cameraGeom", "lsst.obs", "lsst.obs.lsst",
                 "lsst.obs.lsst.translators"):  # fmt: skip
        stand_in(monkeypatch, name)
    stand_in(monkeypatch, "lsst.obs.lsst.translators.lsst", SIMONYI_TELESCOPE="")
    galsim.config.RegisterStampType("LSST_Photons", Photons())
    before = set(sys.modules)
    yield lambda name: importlib.import_module(f"imsim.{name}")
    for name in set(sys.modules) - before:
        if name.startswith("imsim."):
            del sys.modules[name]
    for registry, content in zip(registries, saved, strict=True):
        registry.clear()
        registry.update(content)


def shipped(name="imsim-config.yaml"):
    """imSim's own configuration, as it is written."""
    return yaml.safe_load((IMSIM / "config" / name).read_text())


def configuration(image_type, det_name, **changes):
    """Configuration of one image; the sensor is the item that imSim ships, but for its type."""
    theirs = shipped()
    sensor = {**theirs["image"]["sensor"], "type": "BrighterFatter", **changes}
    rings = IMSIM / "data" / "tree_ring_data" / "tree_ring_parameters_2026-04-02.txt"
    return {
        "modules": ["bfsensor"],
        "eval_variables": {"sdet_name": det_name},
        "input": {"tree_rings": {"file_name": str(rings)}},
        "det_name": det_name,
        "gal": {"type": "DeltaFunction", "flux": 3e5},
        "psf": {"type": "Kolmogorov", "fwhm": 0.6},
        "stamp": {"type": "Basic", "draw_method": "phot", "size": 41},
        "image": {
            "type": image_type, "size": 64, "pixel_scale": 0.2, "nobjects": 2, "nbatch": 2,
            "random_seed": 28657, "det_name": theirs["image"]["det_name"], "sensor": sensor,
            "image_pos": {"type": "XY", "x": "$24.2 + 18 * (obj_num % 2)", "y": 31.4},
        },
    }  # fmt: skip


LOG = galsim.config.LoggerWrapper(logging.getLogger("imsim"))


def draw(config, image_num=0):
    """Image of a configuration without the sky, and the sensor that drew it."""
    galsim.config.ImportModules(config)
    galsim.config.ProcessInput(config)
    galsim.config.SetupConfigFileNum(config, 0, image_num, 0, LOG)
    galsim.config.SetupConfigImageNum(config, image_num, 0, LOG)
    return galsim.config.BuildImage(config, image_num, 0), config["sensor"]


@pytest.mark.parametrize("det_name", TABLES)
def test_lsst_image_draws_each_vendor_with_its_table_and_rings(imsim, det_name):
    imsim("lsst_image")
    rings = imsim("treerings").TreeRings
    config = configuration("LSST_Image", det_name)
    image, sensor = draw(config)
    expected = rings(config["input"]["tree_rings"]["file_name"])
    assert sensor.name == TABLES[det_name]
    assert sensor.treering_center == expected.get_center(det_name)
    assert sensor.treering_func == expected.get_func(det_name)
    assert image.array.sum() == pytest.approx(6e5, rel=0.02)
    # imSim names a table for type Silicon alone.
    assert "name" not in config["image"]["sensor"]
    silicon = configuration("LSST_Image", det_name, type="Silicon")
    silicon["image"]["nobjects"] = 0
    draw(silicon)
    assert (
        Path(silicon["image"]["sensor"]["name"]).name
        == f"lsst_{VENDORS[det_name].lower()}_50_4"
    )


@pytest.mark.parametrize("name", ["imsim-config.yaml", "imsim-config-photon-pooling.yaml"])
def test_one_line_on_top_of_imsims_configuration_is_enough(imsim, name, monkeypatch):
    """The lines of the how-to page: the template, and another type of the sensor."""
    monkeypatch.setattr(
        galsim.config.value_eval, "eval_base_variables",
        [*galsim.config.eval_base_variables, "det_name"],
    )  # fmt: skip
    path = str(IMSIM / "config" / "imsim-config.yaml")
    galsim.config.RegisterTemplate("imsim-config", path)
    config = {
        "modules": ["imsim", "bfsensor"], "template": str(IMSIM / "config" / name),
        "image.sensor.type": "BrighterFatter",
    }  # fmt: skip
    galsim.config.ProcessTemplate(config, config)
    config["det_name"] = "R22_S11"
    sensor = config["image"]["sensor"]
    assert sensor["type"] == "BrighterFatter" and "bfsensor" in config["modules"]
    chosen = choose_options(bfsensor.BrighterFatterSensor, sensor, config, None)
    assert chosen["name"] == "e2v_ccd250" and np.isinf(chosen["full_well"])
    assert chosen["treering_func"]["type"] == "TreeRingFunc"
    assert ("nrecalc" in chosen) == ("pooling" in name)


def test_photon_pooling_meets_the_charge_of_the_pools_before(imsim):
    """imSim's pools with its nrecalc of 0: the second half of the light sees the first."""
    imsim("photon_pooling")
    imsim("treerings")
    theirs = shipped("imsim-config-photon-pooling.yaml")
    sizes = {}
    for strength in (0.0, 4.0):
        config = configuration(
            theirs["image.type"], "R22_S11", strength=strength,
            nrecalc=theirs["image.sensor.nrecalc"],
        )  # fmt: skip
        config["stamp"] = {"type": theirs["stamp.type"], "pool_flux": 300000, "size": 41}
        image, sensor = draw(config)
        assert sensor.name == "e2v_ccd250" and sensor.nrecalc == 0
        assert image.array.sum() == pytest.approx(6e5, rel=0.02)
        star = image[galsim.BoundsI(13, 33, 20, 42)]
        sizes[strength] = star.FindAdaptiveMom().moments_sigma
    # Half of the light meets the charge of the other half, of shifts that are four times as large:
    # 1 % or more; photons and random numbers are the same.
    assert sizes[4.0] / sizes[0.0] > 1.005


@pytest.mark.filterwarnings("ignore:pixels hold more charge than the table")
@pytest.mark.parametrize("det_name", TABLES)
def test_the_readout_bleeds_what_the_sensor_held(imsim, det_name):
    """With the readout that imSim ships the sensor does not spill; imSim's trail is the only one."""
    imsim("lsst_image")
    imsim("treerings")
    readout, trails = imsim("readout"), imsim("bleed_trails")
    outputs = {"readout": shipped()["output"]["readout"]}
    config = {**configuration("LSST_Image", det_name), "output": outputs}
    # Away from the middle of the columns, where imSim lets charge of the upper half escape.
    config["image"]["image_pos"]["y"] = 17.4
    config["gal"]["flux"] = 4e6
    image, sensor = draw(config)
    assert np.isinf(sensor.full_well) and image.array.max() > 2 * WELL
    before = image.array.copy()
    image.header = {"DET_NAME": det_name, "CAMERA": "LsstCamSim", "EXPTIME": 30.0}
    chip = readout.CcdReadout(image, LOG, dark_current=0.0, scti=0, pcti=0)
    chip.bias_level, chip.read_noise = 0.0, 1e-9
    chip.build_amp_images(galsim.BaseDeviate(6765))
    (amplifier,) = (a.array for a in chip.amp_images)
    expected = trails.bleed_eimage(
        before.copy(), WELL, midline_stop=VENDORS[det_name] == "E2V"
    )
    np.testing.assert_allclose(amplifier, expected, atol=0.02)
    assert amplifier.max() == pytest.approx(WELL, abs=0.02)
    # The trails end inside the image: no charge is lost.
    assert amplifier.astype(float).sum() == pytest.approx(
        before.astype(float).sum(), rel=1e-6
    )


def test_a_readout_with_an_infinite_full_well_leaves_the_sensors_trail(imsim):
    imsim("lsst_image")
    imsim("treerings")
    trails = imsim("bleed_trails")
    outputs = {"readout": {**shipped()["output"]["readout"], "full_well": float("inf")}}
    config = {**configuration("LSST_Image", "R22_S11"), "output": outputs}
    config["image"]["nobjects"] = 1
    config["gal"]["flux"] = 4e6
    image, sensor = draw(config)
    assert sensor.full_well == bfsensor.BrighterFatterSensor("e2v_ccd250").full_well
    assert image.array.max() <= sensor.full_well < 2e5
    assert sensor.diagnostics["spilled"] > 1e5
    np.testing.assert_array_equal(
        trails.bleed_eimage(image.array.copy(), float("inf")), image.array
    )


def test_a_run_goes_on_from_imsims_checkpoint(imsim, tmp_path):
    pytest.importorskip("h5py", reason="imSim's checkpoints are HDF files")
    imsim("lsst_image")
    imsim("treerings")
    checkpoint = imsim("checkpoint")
    whole = draw(configuration("LSST_Image", "R22_S11"))[0]

    def interrupted():
        config = configuration("LSST_Image", "R22_S11")
        config["input"]["checkpoint"] = {"dir": str(tmp_path), "file_name": "kept.hdf"}
        return config

    save = checkpoint.Checkpointer.save

    class Stopped(Exception):
        pass

    def stop(self, name, data):
        save(self, name, data)
        raise Stopped

    checkpoint.Checkpointer.save = stop
    with pytest.raises(Stopped):
        draw(interrupted())
    checkpoint.Checkpointer.save = save
    np.testing.assert_array_equal(draw(interrupted())[0].array, whole.array)
