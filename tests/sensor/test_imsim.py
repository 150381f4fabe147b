"""Sensors in a configuration with imSim's structure: one for each detector, one full well."""

from __future__ import annotations

import copy
import logging
from pathlib import Path

import galsim
import numpy as np
import pytest

import bfsensor
from bfsensor.sensor import FocalPlane
from bfsensor.sensor.config import EffectSensorBuilder
from tests.sensor.imsim_stand_in import RING_CENTRES, VENDORS, WELL, Interrupted, bleed

TABLES = {"R01_S00": "itl_sta3800c", "R22_S11": "e2v_ccd250"}
BEYOND = "ignore:pixels hold more charge than the table"
"""A saturated star without a full well in the sensor; the readout bleeds it afterwards."""

(READ,) = galsim.config.ReadConfig(str(Path(__file__).with_name("imsim_structure.yaml")))


def configuration(folder, sensor=None, **output):
    """Configuration of the file, written to a folder, with changes of its sensor and output."""
    config = copy.deepcopy(READ)
    config["image"]["sensor"].update(sensor or {})
    config["output"].update({"dir": str(folder), **output})
    if config["output"]["readout"]:
        config["output"]["readout"]["dir"] = str(folder)
    return config


def process(config, logger=None):
    """Run a configuration; e-images, their headers and the images of the readout by detector."""
    galsim.config.Process(config, logger=logger, except_abort=True)
    folder = Path(config["output"]["dir"])
    images, headers, amplifiers = {}, {}, {}
    for detector in config["output"]["only_dets"]:
        path = folder / f"eimage_{detector}.fits"
        images[detector] = galsim.fits.read(str(path)).array
        headers[detector] = galsim.FitsHeader(str(path))
        if (path := folder / f"amp_{detector}.fits").exists():
            amplifiers[detector] = galsim.fits.read(str(path)).array
    return images, headers, amplifiers


@pytest.fixture(scope="module")
def two_processes(tmp_path_factory):
    return process(configuration(tmp_path_factory.mktemp("two")))


# -- a sensor for each detector ------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.filterwarnings(BEYOND)
def test_an_itl_and_an_e2v_detector_in_two_processes(two_processes, tmp_path):
    """Each detector has the table and the rings of its own, and the bits of that table by name."""
    images, headers, _ = two_processes
    by_name = {
        name: process(configuration(tmp_path / name, {"name": name}, nproc=1))[0]
        for name in TABLES.values()
    }
    for detector, table in TABLES.items():
        assert table in headers[detector]["SENSOR"]
        assert headers[detector]["RINGX"] == RING_CENTRES[detector][0]
        for name, alone in by_name.items():
            assert np.array_equal(alone[detector], images[detector]) == (name == table)


@pytest.mark.filterwarnings(BEYOND)
def test_one_process_chooses_anew_for_each_detector(two_processes, tmp_path):
    images, headers, _ = process(configuration(tmp_path, nproc=1))
    for detector, table in TABLES.items():
        assert table in headers[detector]["SENSOR"]
        np.testing.assert_array_equal(images[detector], two_processes[0][detector])


@pytest.mark.filterwarnings(BEYOND)
def test_stamps_in_two_processes_have_the_sensor_of_their_detector(two_processes, tmp_path):
    config = configuration(tmp_path, nproc=1)
    config["image"]["nproc"] = 2
    images = process(config)[0]
    for detector in TABLES:
        np.testing.assert_array_equal(images[detector], two_processes[0][detector])


def build(sensor, base=None, kind=bfsensor.BrighterFatterSensor):
    builder = EffectSensorBuilder(kind)
    return builder.buildSensor(
        dict(sensor), {"rng": galsim.BaseDeviate(77), **(base or {})}, None
    )


@pytest.mark.parametrize(
    ("sensor", "base", "table"),
    [
        ({}, {}, "itl_sta3800c"),
        ({}, {"det_name": "R22_S11"}, "e2v_ccd250"),
        ({}, {"det_name": "R01_S00", "image": {"det_name": "R22_S11"}}, "e2v_ccd250"),
        ({"det_name": "R22_S11"}, {"image": {"det_name": "R01_S00"}}, "e2v_ccd250"),
        ({"name": "itl_sta3800c_60"}, {"det_name": "R22_S11"}, "itl_sta3800c_60"),
        ({}, {"det_name": "R22_S11", "image": {"camera": "LsstCam"}}, "e2v_ccd250"),
        ({}, {"det_name": "R22_S11", "output": {"camera": "LsstComCamSim"}}, "itl_sta3800c"),
        ({"focal_plane": "LsstComCam", "det_name": "R22_S11"}, {}, "itl_sta3800c"),
    ],
)  # fmt: skip
def test_where_the_detector_and_its_camera_are_looked_up(sensor, base, table):
    assert build(sensor, base).name == table


def test_a_sensor_with_galsims_tables_has_that_of_the_vendor():
    for detector, vendor in VENDORS.items():
        sensor = build({}, {"det_name": detector}, bfsensor.SiliconSensor)
        assert sensor == bfsensor.SiliconSensor(
            f"lsst_{vendor.lower()}_50_8", rng=galsim.BaseDeviate(77)
        )


@pytest.mark.parametrize(
    ("sensor", "base", "error", "message"),
    [
        ({"name": "e2v_ccd250", "focal_plane": "LsstCam"}, {}, galsim.GalSimConfigError,
         "gives name and focal_plane"),
        ({"focal_plane": "LsstCam"}, {}, galsim.GalSimConfigError, "needs a detector"),
        ({"det_name": "R22_S33"}, {}, bfsensor.SensorError,
         "lsstcam.ecsv does not list the detector 'R22_S33'"),
        ({"det_name": "R00_SW0"}, {}, bfsensor.SensorError, "names no table for R00_SW0"),
        ({"det_name": "S1"}, {"image": {"camera": "HSC"}}, bfsensor.SensorError,
         "the camera 'HSC' has no built-in focal plane"),
        ({"det_name": "S1", "focal_plane": "HSC"}, {}, bfsensor.SensorError,
         "focal_plane = 'HSC' is neither a camera"),
    ],
)  # fmt: skip
def test_what_cannot_be_chosen_is_refused(sensor, base, error, message):
    with pytest.raises(error, match=message):
        build(sensor, base)


# -- files of focal planes -----------------------------------------------------------------


@pytest.mark.parametrize(
    ("camera", "vendors"),
    [("LsstCamSim", {"E2V": 117, "ITL": 88}), ("LsstComCamSim", {"ITL": 9})],
)
def test_built_in_focal_planes(camera, vendors):
    """13 of the 21 rafts have E2V's CCDs; the corners have 8 guiders and 8 wavefront sensors."""
    plane = FocalPlane.read(camera)
    found = [row["vendor"] for row in plane.rows.values()]
    assert {vendor: found.count(vendor) for vendor in set(found)} == vendors
    rafts = {}
    for detector, row in plane.rows.items():
        assert row["serial"].startswith(row["vendor"])
        rafts.setdefault(detector[:3], set()).add(row["vendor"])
        if row["serial"].startswith("ITL-4400B"):
            assert "table" not in row and detector[4:6] == "SW"
            continue
        table = {"E2V": "e2v_ccd250", "ITL": "itl_sta3800c"}[row["vendor"]]
        # The temperature of no detector is known: that of the device holds.
        assert plane.options(detector) == {"name": table}
    assert all(len(kinds) == 1 for kinds in rafts.values())


def test_a_file_of_ones_own_chooses_tables_and_options(tmp_path):
    (tmp_path / "mine.fits").symlink_to(
        Path(bfsensor.__file__).parents[1] / "tables" / "itl_sta3800c_60" / "table.fits"
    )
    (tmp_path / "plane.ecsv").write_text(
        "# %ECSV 1.0\n# ---\n# datatype:\n# - {name: detector, datatype: string}\n"
        "# - {name: table, datatype: string}\n"
        "# - {name: back_bias, unit: kV, datatype: float64}\n"
        "# - {name: temperature, unit: deg_C, datatype: float64}\n"
        "# - {name: strength, datatype: float64}\n# schema: astropy-2.0\n"
        "detector table back_bias temperature strength\n"
        'A mine.fits -0.06 -95.0 ""\nB e2v_ccd250_70 -0.07 "" 0.5\n'
    )
    (tmp_path / "plane.csv").write_text(
        "detector,table,back_bias,temperature,strength\n"
        "A,mine.fits,-60,178.15,\nB,e2v_ccd250_70,-70,,0.5\n"
    )
    for name in ("plane.ecsv", "plane.csv"):
        file = {"focal_plane": str(tmp_path / name)}
        first, second = (build({**file, "det_name": detector}) for detector in "AB")
        assert (Path(first.name), first.strength) == (tmp_path / "mine.fits", 1.0)
        assert first.temperature == pytest.approx(178.15, abs=1e-9)
        assert (second.name, second.temperature, second.strength) == (
            "e2v_ccd250_70",
            173,
            0.5,
        )
        # What the configuration says precedes what the file says.
        assert build({**file, "det_name": "B", "strength": 2.0}).strength == 2.0


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("detector,table,back_bias\nA,e2v_ccd250,-70\n",
         "A: back_bias = -70 V, but the table e2v_ccd250 was solved for -50 V"),
        ("detector,table,voltage\nA,e2v_ccd250,-70\n", "the column 'voltage' is none of"),
        ("detector,vendor\nA,ITL\n", "has no column 'table'"),
        ("detector,table\nA,e2v_ccd250\nA,itl_sta3800c\n", "lists A twice"),
        ("detector,table,strength\nA,e2v_ccd250,strong\n", "strength = 'strong' is no number"),
        ("detector,table\nA,e2v\n", "name = 'e2v' is neither a built-in table"),
    ],
)  # fmt: skip
def test_wrong_files_are_refused(rows, message, tmp_path):
    (tmp_path / "plane.csv").write_text(rows)
    with pytest.raises(bfsensor.SensorError, match=message):
        build({"focal_plane": str(tmp_path / "plane.csv"), "det_name": "A"})


def test_an_option_that_the_sensor_does_not_take_is_refused(tmp_path):
    (tmp_path / "p.csv").write_text(
        "detector,table,vendor,temperature\nA,e2v_ccd250,E2V,170\n"
    )
    sensor = {"focal_plane": str(tmp_path / "p.csv"), "det_name": "A"}
    assert build(sensor).temperature == 170
    with pytest.raises(
        bfsensor.SensorError, match="temperature is no option of SiliconSensor"
    ):
        build(sensor, kind=bfsensor.SiliconSensor)


# -- one full well -------------------------------------------------------------------------


@pytest.mark.filterwarnings(BEYOND)
def test_the_full_well_acts_once_in_the_readout(two_processes):
    """By default the sensor holds what the star brings, and the readout alone makes its trail."""
    images, headers, amplifiers = two_processes
    for detector, vendor in VENDORS.items():
        image, amplifier = images[detector].astype(float), amplifiers[detector]
        well = bfsensor.BrighterFatterSensor(TABLES[detector]).full_well
        assert image.max() > 1.2 * well > WELL
        assert headers[detector]["SPILLED"] == 0.0
        np.testing.assert_array_equal(
            amplifier, bleed(images[detector], WELL, midline=vendor == "E2V")
        )
        # Single precision holds 1e5 e- to 0.004 e-; thousands of pixels are summed.
        assert amplifier.astype(float).sum() == pytest.approx(image.sum(), abs=10.0)
        assert amplifier.max() == WELL
        assert (amplifier == WELL).sum() > (image > WELL).sum()


@pytest.mark.parametrize(
    ("readout", "sensor"), [({"full_well": float("inf")}, {}), ("", {})]
)
def test_without_bleeding_in_the_readout_the_sensor_spills(readout, sensor, tmp_path):
    """imSim's readout with an infinite full well leaves images as they are."""
    if readout:
        readout = {**READ["output"]["readout"], **readout}
    images, headers, amplifiers = process(
        configuration(tmp_path, sensor, nproc=1, readout=readout)
    )
    for detector, table in TABLES.items():
        sky = 6 * np.sqrt(READ["image"]["sky_level"]) + READ["image"]["sky_level"]
        well = bfsensor.BrighterFatterSensor(table).full_well
        # Stamps of three stars are added, and then the sky; each star spills by itself.
        assert well - 1 < images[detector].max() < well + sky + 4e3
        assert headers[detector]["SPILLED"] == 0.0  # the last star is faint
        if readout:
            np.testing.assert_array_equal(amplifiers[detector], images[detector])


@pytest.mark.parametrize("well", [1e5, float("inf")])
def test_a_full_well_that_is_given_holds_and_both_acting_is_said(well, caplog):
    logger = galsim.config.LoggerWrapper(logging.getLogger("both"))
    sensor, base = {"full_well": well}, {"output": {"readout": {"file_name": "amp.fits"}}}
    with caplog.at_level(logging.WARNING, "both"):
        built = EffectSensorBuilder(bfsensor.BrighterFatterSensor).buildSensor(
            sensor, {"rng": galsim.BaseDeviate(77), **base}, logger
        )
    assert built.full_well == well
    assert ("both act" in caplog.text) == (well == 1e5)


def test_the_log_says_what_was_chosen(caplog):
    with caplog.at_level(logging.INFO, "chosen"):
        EffectSensorBuilder(bfsensor.BrighterFatterSensor).buildSensor(
            {}, {"rng": galsim.BaseDeviate(77), "det_name": "R22_S11",
                 "output": {"readout": {"file_name": "amp.fits"}}},
            logging.getLogger("chosen"),
        )  # fmt: skip
    assert (
        "detector R22_S11: table e2v_ccd250; full well left to output.readout"
        in caplog.text
    )


# -- pools of photons and checkpoints ------------------------------------------------------


def pooled(folder, sensor=None, flux=6e5, nbatch=6, **checkpoint):
    """Configuration of pools on an E2V detector, one faint enough for its table."""
    config = configuration(
        folder, {"nrecalc": 0, **(sensor or {})}, nproc=1, only_dets=["R22_S11"], readout=""
    )
    image = config["image"]
    image.update(type="StandInPooledImage", nobjects=3, nbatch=nbatch, size=96)
    for key in ("sky_level", "noise"):
        del image[key]
    config["stamp"] = {"type": "StandInPhotons", "size": 31, "pool_flux": flux}
    if checkpoint:
        config["input"] = {"stand_in_checkpoint": checkpoint}
    return config


def mean_size(image):
    """Mean sigma of the three stars [pixel]."""
    found = []
    items = READ["image"]["image_pos"]
    for x, y in zip(items["x"]["items"], items["y"]["items"], strict=True):
        i, j = round(x), round(y)
        stamp = galsim.Image(image[j - 12 : j + 11, i - 12 : i + 11].astype(float))
        found.append(stamp.FindAdaptiveMom().moments_sigma)
    return np.mean(found)


def test_pools_renew_boundaries_although_nrecalc_is_zero(tmp_path):
    """The later pools meet the charge of those before; with one pool no charge is met."""
    sizes = {
        (nbatch, strength): mean_size(
            process(pooled(tmp_path / f"{nbatch}_{strength}", {"strength": strength},
                           nbatch=nbatch))[0]["R22_S11"]
        )
        for nbatch in (1, 6) for strength in (0.0, 1.0)
    }  # fmt: skip
    assert sizes[1, 1.0] == sizes[1, 0.0]
    # The error of the mean sigma of three stars of 6e5 photons is 1 / sqrt(2 * 1.8e6), 0.05 %.
    assert 0.008 < sizes[6, 1.0] / sizes[6, 0.0] - 1 < 0.02


@pytest.mark.parametrize("kind", ["StandInImage", "StandInPooledImage"])
def test_a_run_goes_on_from_its_checkpoint(kind, tmp_path):
    """The restarted sensor is a new one; it meets the charge that the checkpoint brought."""
    pools = kind == "StandInPooledImage"
    # A prediction of the charge needs the pool before, which the restarted sensor did not see.
    strong = {"strength": 4.0, "predict": False}
    whole = pooled(tmp_path / "whole", strong, nbatch=3)
    kept = {"file_name": str(tmp_path / "kept"), "stop_after": 2}
    part = pooled(tmp_path / "part", strong, nbatch=3, **kept)
    if not pools:
        for config in (whole, part):
            config["image"]["type"] = kind
            config["stamp"] = {"draw_method": "phot", "size": 31}
    expected = process(whole)[0]["R22_S11"]
    with pytest.raises(Interrupted):
        process(part)
    del part["input"]["stand_in_checkpoint"]["stop_after"]
    found = process(part)[0]["R22_S11"]
    if not pools:
        # Each star has a seed of its own, and no other star's charge on its stamp.
        np.testing.assert_array_equal(found, expected)
        return
    # The last of three pools has other random numbers: sizes differ by their noise, 0.05 % each.
    # Stars grow by 3 % in three pools; two thirds of it come in the last, by the charge of two.
    assert mean_size(found) == pytest.approx(mean_size(expected), rel=0.004)
    off = process(pooled(tmp_path / "off", {"strength": 0.0}, nbatch=3))[0]["R22_S11"]
    assert mean_size(found) / mean_size(off) > 1.02
    assert found.sum() == pytest.approx(expected.sum(), rel=1e-3)
