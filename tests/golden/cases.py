"""What is made: tables, stars, flats, fits and diagnoses, through commands and public classes."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import galsim
import numpy as np

DATA = Path(__file__).parents[1] / "data"


@dataclass(frozen=True)
class Product:
    """Parts that are compared bit for bit, and numbers for machines that round otherwise.

    Attributes
    ----------
    parts : dict
        Arrays and texts by name.
    numbers : dict of float
        A few of their numbers, by name.
    """

    parts: Mapping[str, Any]
    numbers: Mapping[str, float]

    def digests(self) -> dict[str, str]:
        """SHA-256 of each part: type, shape and bytes of an array, or a text's bytes."""
        return {name: _digest(part) for name, part in self.parts.items()}


@dataclass(frozen=True)
class Case:
    """One thing to make.

    Attributes
    ----------
    make : callable
        Gives the :class:`Product`.
    quick : bool
        Part of every test run.
    tolerance : float
        Relative difference of numbers that another machine may show.  Solvers end at a
        residual, not at a bit: tables agree to their stated iteration error.  Photons land in
        another pixel where the last bit of a position decides.  Fits end where a step gains less
        than a hundredth of chi-square, a tenth of an error; their ``NUMBER width`` is that of the
        68 % interval, and NUMBER may differ by a fifth of it.
    """

    make: Callable[[], Product]
    quick: bool
    tolerance: float


def _digest(part: Any) -> str:
    if isinstance(part, str):
        return hashlib.sha256(part.encode()).hexdigest()
    array = np.ascontiguousarray(part)
    if array.dtype.hasobject:
        raise TypeError(f"a part of type {type(part).__name__} has no bytes to compare")
    head = f"{array.dtype.str} {array.shape} ".encode()
    return hashlib.sha256(head + array.tobytes()).hexdigest()


def run_command(*words: object) -> str:
    """Run a command of the package in this process and give its standard output."""
    from bfsensor.cli.main import main

    out, said = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(said):
        status = main([str(word) for word in words], standalone_mode=False)
    if status:
        raise RuntimeError(f"bfsensor {words[0]} ended with {status}: {said.getvalue()}")
    return out.getvalue()


# -- tables ------------------------------------------------------------------------------


def _table(*options: object) -> Product:
    from bfsensor import DistortionTable

    with TemporaryDirectory() as folder:
        path = Path(folder) / "table.fits"
        run_command("table", *options, "--no-figure", "-o", path)
        table = DistortionTable.read(path)
    changes = table.area_changes(
        charge=float(table.charges[-1]), background=float(table.backgrounds[-1]),
        depth=float(table.depths[-1]),
    )  # fmt: skip
    centre = table.reach
    return Product(
        {
            "corners": table.corners,
            "horizontal": table.horizontal,
            "vertical": table.vertical,
            "device": table.device_text,
        },
        {
            f"area change ({i},{j}) [um2]": float(changes[centre + j, centre + i])
            for i, j in ((0, 0), (1, 0), (0, 1), (1, 1))
        }
        | {"full well [e-]": float(table.full_well)},
    )


IMAGE_CHARGE = (
    "charge_height=0.32um", "row_height=1.21um", "column_height=2.57um", "half_width_x=0.2um",
    "half_width_y=3.8um", "drift_field=0um:0.736V/um,100um:0.364V/um",
)  # fmt: skip
SIXTEEN = ("--accuracy", 0.05, "--no-assess", "--workers", 1)

TABLES = {
    "table/itl_16": lambda: _table(
        "itl_sta3800c", "--charges", "0,80000", "--backgrounds", "0,40000", "--depths",
        "5,50,100", "--vertices", 8, *SIXTEEN,
    ),
    "table/itl": lambda: _table(
        "itl_sta3800c", "--charges", "50000,100000", "--backgrounds", "0", "--depths", "20,100",
        "--no-assess", "--workers", 1,
    ),
    "table/e2v_70": lambda: _table(
        "e2v_ccd250", "--set", "back_bias=-70V", "--charges", "0,60000", "--backgrounds",
        "0,30000", "--depths", "10,95", *SIXTEEN,
    ),
    "table/e2v_2019": lambda: _table(
        "e2v_ccd250_2019", "--charges", "0,50000", "--backgrounds", "0,20000", "--depths",
        "20,98", "--pixels", 5, "--vertices", 8, *SIXTEEN,
    ),
    "table/itl_2019": lambda: _table(
        "itl_sta3800c_2019", "--charges", "0,120000", "--backgrounds", "0", "--depths", "98",
        "--vertices", 8, *SIXTEEN,
    ),
    "table/image_charge": lambda: _table(
        "itl_sta3800c", "--engine", "image_charge",
        *(word for value in IMAGE_CHARGE for word in ("--image-charge", value)),
    ),
}  # fmt: skip


# -- stars and flats ---------------------------------------------------------------------


def _image(image: galsim.Image) -> Product:
    moments = galsim.hsm.FindAdaptiveMom(image)
    return Product(
        {"image": image.array},
        {
            "sum [e-]": float(image.array.sum(dtype=float)),
            "peak [e-]": float(image.array.max()),
            "sigma [pixel]": float(moments.moments_sigma),
        },
    )


def _rings() -> dict[str, Any]:
    return {
        "treering_func": galsim.SiliconSensor.simple_treerings(0.26, 47.0, r_max=3000.0),
        "treering_center": galsim.PositionD(-900.0, 400.0),
    }


def _star(sensor: galsim.SiliconSensor, flux: float, seed: int, *, red: bool) -> Product:
    rng = galsim.BaseDeviate(seed)
    light: list[galsim.PhotonOp] = []
    if red:
        spectrum = galsim.SED("vega.txt", wave_type="nm", flux_type="fnu")
        light = [
            galsim.WavelengthSampler(
                spectrum, galsim.Bandpass("LSST_y.dat", wave_type="nm")
            ),
            galsim.FRatioAngles(1.234, 0.606),
        ]
    star = galsim.Moffat(beta=3, fwhm=0.7, flux=flux)
    return _image(
        star.drawImage(
            nx=43,
            ny=43,
            scale=0.2,
            method="phot",
            sensor=sensor,
            rng=rng,
            photon_ops=light,
            poisson_flux=False,
        )
    )


def _itl_star() -> Product:
    import bfsensor

    sensor = bfsensor.BrighterFatterSensor("itl_sta3800c", rng=galsim.BaseDeviate(815))
    return _star(sensor, 4e5, 3661, red=False)


def _e2v_star() -> Product:
    """Red, slanted light, rings, and a peak above the full well."""
    import bfsensor

    sensor = bfsensor.BrighterFatterSensor(
        "e2v_ccd250", rng=galsim.BaseDeviate(277), **_rings()
    )
    return _star(sensor, 4e6, 911, red=True)


def _galsim_star() -> Product:
    """GalSim's files and physics, with rings."""
    import bfsensor

    sensor = bfsensor.SiliconSensor(rng=galsim.BaseDeviate(93), **_rings())
    return _star(sensor, 4e5, 1207, red=True)


def _flat(sensor: galsim.SiliconSensor) -> Product:
    from bfsensor.sensor.flats import draw_flat

    image = draw_flat(sensor, (64, 48), 6e4, rng=galsim.BaseDeviate(5150)).array
    return Product(
        {"flat": image},
        {
            "mean [e-]": float(image.mean(dtype=float)),
            "variance [e-2]": float(image.var(dtype=float)),
        },
    )


def _itl_flat() -> Product:
    import bfsensor

    return _flat(bfsensor.BrighterFatterSensor("itl_sta3800c"))


def _galsim_flat() -> Product:
    import bfsensor

    return _flat(bfsensor.SiliconSensor("lsst_e2v_50_8", **_rings()))


# -- fits --------------------------------------------------------------------------------


def _fit(device: str, recording: str, *options: object) -> Product:
    with TemporaryDirectory() as folder:
        run_command("fit", device, DATA / recording, *options, "-o", folder)
        found = json.loads((Path(folder) / "fit.json").read_text())
    errors = np.sqrt(np.diag(np.asarray(found["covariance"], dtype=float)))
    numbers = dict(zip(found["parameters"], map(float, found["value"]), strict=True))
    numbers |= {
        f"{name} width": 2 * float(error)
        for name, error in zip(found["parameters"], errors, strict=True)
    }
    return Product({"fit": _without_words(found)}, numbers)


COARSE = ("--cells", 8, "--finer", 0, "--draws", 0)


# -- diagnoses ---------------------------------------------------------------------------


def _without_words(found: Any) -> str:
    """Numbers and names of a report as a text, without sentences (spaces) and paths (slashes)."""

    def kept(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {k: kept(v) for k, v in sorted(value.items()) if k not in DATED}
        if isinstance(value, list | tuple):
            return [kept(v) for v in value]
        return "" if isinstance(value, str) and {" ", "/"} & set(value) else value

    return json.dumps(kept(found), indent=0, sort_keys=True)


DATED = ("version", "date", "command", "commit", "seconds", "cpu_s", "wall_s")


def _diagnosis(
    seed: int, size: str, *effects: tuple[str, dict[str, float], str]
) -> Product:
    """Diagnose a campaign of the virtual sensor through its files, as a user would."""
    from tests.virtual import make_effect, write_campaign

    with TemporaryDirectory() as folder:
        campaign = Path(folder) / "campaign"
        made = [make_effect(word, values, variant) for word, values, variant in effects]
        write_campaign(
            campaign,
            seed=seed,
            size=size,
            effects=made,
            salt="golden",
            truth_folder=Path(folder) / "truth",
        )
        return _report(campaign, folder)


def _report(recordings: Path, folder: str, *options: object) -> Product:
    out = Path(folder) / "out"
    run_command("diagnose", recordings, *options, "-o", out)
    found = json.loads((out / "report.json").read_text())
    # Date, seconds and host differ from run to run.
    del found["provenance"]
    numbers = {"p_value": found["p_value"]}
    numbers |= {f"chi2 {word}": held["chi2"] for word, held in found["channels"].items()}
    for effect in found["effects"]:
        for name, told in effect["parameters"].items():
            where = f"{effect['class']} {name}"
            numbers[where] = told["value"]
            low, high = told.get("lo68"), told.get("hi68")
            if low is not None and high is not None:
                numbers[f"{where} width"] = high - low
    return Product({"report": _without_words(found)}, numbers)


def _areas(device: str, recording: str, *options: object) -> Product:
    with TemporaryDirectory() as folder:
        return _report(DATA / recording, folder, "--baseline", device, *options)


TEAR = ("tearing", {"amp": 0.008, "length": 2.0, "column": 0.3}, "")
TRAP = ("trap_serial", {"size": 30.0, "tau": 1.5, "amp": 0.0}, "")
ECHO = ("outside_library", {"amp": -3e-4}, "echo")
EXCHANGED = ("outside_library", {"amp": 1.0}, "axes_exchanged")
RINGS = (
    "tree_rings", {"amp": 0.012, "period": 24.0, "xc": -80.0, "yc": 310.0, "chirp": 0.01}, ""
)  # fmt: skip
NONLINEAR = ("gain_nonlinearity", {"c2": -0.008, "c3": 4e-4}, "")
TURBULENCE = ("illumination_turbulence", {"rms": 5e-4, "corr": 25.0}, "")
PERSISTENCE = ("persistence", {"frac": 4e-4, "tau": 2.0}, "")
FRINGES = ("fringing", {"amp": 5e-3, "period": 33.0}, "")
COUPLING = ("interpixel_coupling", {"ax": 1e-3, "ay": 7e-4}, "")
ANISOTROPY = ("bf_anisotropy", {"eps": 0.1}, "")
DIAGNOSES = {
    "diagnosis/null": (lambda: _diagnosis(771, "T"), True),
    "diagnosis/tearing": (lambda: _diagnosis(7101, "T", TEAR), True),
    "diagnosis/trap_serial": (lambda: _diagnosis(31, "T", TRAP), False),
    "diagnosis/echo": (lambda: _diagnosis(2203, "T", ECHO), False),
    "diagnosis/tree_rings": (lambda: _diagnosis(411, "S", RINGS), False),
    "diagnosis/gain_nonlinearity": (lambda: _diagnosis(412, "S", NONLINEAR), False),
    "diagnosis/turbulence": (lambda: _diagnosis(413, "S", TURBULENCE), False),
    "diagnosis/persistence": (lambda: _diagnosis(414, "S", PERSISTENCE), False),
    "diagnosis/fringing": (lambda: _diagnosis(415, "S", FRINGES), False),
    "diagnosis/interpixel_coupling": (lambda: _diagnosis(416, "S", COUPLING), False),
    "diagnosis/bf_anisotropy": (lambda: _diagnosis(417, "S", ANISOTROPY), False),
    "diagnosis/axes_exchanged": (lambda: _diagnosis(418, "S", EXCHANGED), False),
    "diagnosis/e2v_areas": (
        lambda: _areas(
            "e2v_ccd250", "e2v_covariances_21oct19.csv", "--towards", "e2v_ccd250_70"
        ),
        False,
    ),
}

CASES: dict[str, Case] = {
    **{
        name: Case(make, name in ("table/itl_16", "table/image_charge"), 1e-6)
        for name, make in TABLES.items()
    },
    "star/itl": Case(_itl_star, True, 2e-3),
    "star/e2v_red_rings_full": Case(_e2v_star, True, 2e-3),
    "star/galsim_rings": Case(_galsim_star, True, 2e-3),
    "flat/itl": Case(_itl_flat, True, 1e-3),
    "flat/galsim_rings": Case(_galsim_flat, True, 1e-3),
    "fit/itl": Case(
        lambda: _fit("itl_sta3800c_60", "itl_covariances_21oct19.csv", *COARSE), True, 1e-3
    ),
    "fit/e2v": Case(
        lambda: _fit("e2v_ccd250_70", "e2v_covariances_21oct19.csv", *COARSE), False, 1e-3
    ),
    **{name: Case(make, quick, 1e-2) for name, (make, quick) in DIAGNOSES.items()},
}  # fmt: skip
