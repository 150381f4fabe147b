"""A law: one published (or invented) way in which a sensor differs from the baseline.

A law overrides the hooks of the stages it acts at; all others leave everything as it is.  The
order of stages is that of charge: light, edges, collection, storage, transfer, amplifier,
converter.  ``values`` holds its parameters by the names of the diagnosis' contract; the one named
by ``amplitude`` is scaled to reach a wanted projected SNR, and at ``neutral`` the law changes
nothing, bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from validation.foreign.collection import Image, Light, Term
from validation.foreign.device import Device
from validation.foreign.layout import Layout
from validation.foreign.plan import Exposure, Plan


@dataclass
class Setting:
    """What a law may know of the bench it works in.

    Attributes
    ----------
    layout, plan
        Amplifiers and exposures.
    nominal, device : Device
        As on the card, and as it is.
    gains, noises : list of float
        Of the amplifiers [e-/ADU], [e-].
    seed : int
        Of the campaign; laws draw from streams of their own.
    """

    layout: Layout
    plan: Plan
    nominal: Device
    device: Device
    gains: list[float]
    noises: list[float]
    seed: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the sensor."""
        return self.layout.pixels, self.layout.pixels


@dataclass
class Law:
    """Base of all laws and nuisances; every hook leaves its argument as it is.

    Attributes
    ----------
    values : dict
        Parameters; numbers, or lists of numbers for places.
    """

    values: dict[str, Any] = field(default_factory=dict)
    setting: Setting | None = field(default=None, repr=False)
    state: dict[str, Any] = field(default_factory=dict, repr=False)

    word: ClassVar[str] = ""
    name: ClassVar[str] = ""
    source: ClassVar[str] = ""
    amplitude: ClassVar[str] = ""
    neutral: ClassVar[float] = 0.0
    limits: ClassVar[tuple[float, float]] = (0.0, np.inf)
    start: ClassVar[float] = 1.0
    needs: ClassVar[frozenset[str]] = frozenset()
    power: ClassVar[float] = 1.0
    scaled: ClassVar[bool] = True
    beside: ClassVar[frozenset[str]] = frozenset()

    @classmethod
    def draw(cls, rng: np.random.Generator, setting: Setting) -> dict[str, Any]:
        """Draw the parameters but for the amplitude; a sign is drawn under the key 'sign'."""
        return {}

    def begin(self, setting: Setting) -> None:
        """Get to know the bench; called before the first exposure."""
        self.setting = setting
        self.state = {}
        self.settle()

    def settle(self) -> None:
        """Work out parameters that follow from others, for the truth."""

    def set_amplitude(self, size: float) -> None:
        """Give the amplitude a size above neutral; its sign is that drawn."""
        self.values[self.amplitude] = self.neutral + self.values.get("sign", 1.0) * size
        self.settle()

    @property
    def size(self) -> float:
        """Amplitude's distance from neutral."""
        return abs(self.values[self.amplitude] - self.neutral)

    def rng(self, exposure: Exposure | None = None, extra: int = 0) -> np.random.Generator:
        """A stream of the law's own, the same for an exposure whatever was taken before."""
        assert self.setting is not None
        at = 10**6 if exposure is None else exposure.sequence
        tag = [ord(c) for c in (self.word + self.name)[:40]]
        return np.random.default_rng([self.setting.seed, at, extra, *tag])

    # ---- light and edges
    def seconds(self, seconds: Any, exposure: Exposure) -> Any:
        """Time that the light is on, a number or a map."""
        return seconds

    def recorded(self, seconds: float, exposure: Exposure) -> float:
        """Exposure time that the header states."""
        return seconds

    def lamp(self, level: float, exposure: Exposure) -> float:
        """Lamp's current over the nominal one."""
        return level

    def spot_shape(self, sx: NDArray, sy: NDArray, exposure: Exposure):
        """Widths of the spots [pixel]."""
        return sx, sy

    def light(self, light: Light, exposure: Exposure) -> Light:
        """The light itself."""
        return light

    def fixed_edges(self, dx: Image, dy: Image, exposure: Exposure) -> tuple[Image, Image]:
        """Shifts of edges that do not depend on charge [pixel]."""
        return dx, dy

    def terms(self, terms: list[Term], exposure: Exposure) -> list[Term]:
        """Shifts of edges by charge."""
        return terms

    def modulation(self, exposure: Exposure) -> Callable | None:
        """A last say in the shifts by charge; see :class:`Edges`."""
        return None

    def device(self, device: Device, exposure: Exposure) -> Device:
        """The sensor that the shifts are computed for."""
        return device

    def absorption(self, length: float, exposure: Exposure) -> float:
        """Absorption length of the light [um]."""
        return length

    def efficiency(self, charge: Image) -> Image | float:
        """Fraction of light collected at a stored charge."""
        return 1.0

    # ---- stored charge
    def extra_charge(self, charge: Image, exposure: Exposure) -> Image:
        """Charge added beside the light (dark current, particles, left from before)."""
        return charge

    def stored(self, charge: Image, exposure: Exposure) -> Image:
        """What becomes of stored charge (full well, coupling)."""
        return charge

    def remember(self, charge: Image, exposure: Exposure) -> Image:
        """Look at an exposure's charge for what it leaves behind; returns what is read out."""
        return charge

    # ---- transfer and amplifier; frames in readout order [e-]
    def parallel(self, frame: Image, number: int, exposure: Exposure) -> Image:
        """Transfer along columns; rows with parallel overscan, columns of light."""
        return frame

    def serial(self, frame: Image, number: int, exposure: Exposure) -> Image:
        """Transfer along rows; full frames with prescan and overscans."""
        return frame

    def amplifiers(self, frames: list[Image], exposure: Exposure) -> list[Image]:
        """Amplifiers, all at once [e-], before noise."""
        return frames

    def noise(self, frames: list[Image], exposure: Exposure) -> list[Image]:
        """Noise and offsets added to the frames [e-]."""
        return frames

    def codes(self, frames: list[NDArray], exposure: Exposure) -> list[NDArray]:
        """Converter: whole codes [ADU] to the codes that are written."""
        return frames

    # ---- for the truth
    def truth(self) -> dict[str, Any]:
        """Parameters by name."""
        return {k: _plain(v) for k, v in self.values.items() if k != "sign"}


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    return value


def after(term: Term, change: Callable[[Image], Image]) -> Callable[[Image], Image]:
    """Source of a term, with a change of the charge that it answers to put after what it has."""
    if term.source is None:
        return change
    source = term.source
    return lambda q: change(source(q))


HOOKS = (
    "seconds", "recorded", "lamp", "spot_shape", "light", "fixed_edges", "terms", "modulation",
    "device", "absorption", "efficiency", "extra_charge", "stored", "remember", "parallel",
    "serial", "amplifiers", "noise", "codes",
)  # fmt: skip

LAWS: dict[tuple[str, str], type[Law]] = {}
"""All laws by class word and name."""


def law(
    word: str,
    name: str,
    *,
    amplitude: str,
    start: float,
    limits: tuple[float, float],
    source: str,
    needs: Sequence[str] = (),
    power: float = 1.0,
    neutral: float = 0.0,
    scaled: bool = True,
    beside: Sequence[str] = (),
) -> Callable[[type[Law]], type[Law]]:
    """Register a law.

    Parameters
    ----------
    word, name : str
        Class word of the taxonomy, and the law's own name.
    amplitude : str
        Parameter that sets how strong the law is.
    start : float
        Amplitude of about 100 sigma in a campaign of size S; a first guess, corrected by the
        estimator of :mod:`validation.foreign.strength`.
    limits : (float, float)
        Smallest and largest amplitude that a real sensor may have.
    source : str
        Equation and paper.
    needs : sequence of str
        What a campaign must record for the law to be seen.
    power : float
        Power of the amplitude that the SNR goes with, near 100 sigma.
    neutral : float
        Amplitude at which the law changes nothing.
    scaled : bool
        False where the amplitude is drawn as it is (log-uniform within limits).
    beside : sequence of str
        Nuisances that the law cannot be told from and that are left out beside it.
    """

    def register(cls: type[Law]) -> type[Law]:
        cls.word, cls.name, cls.amplitude, cls.start = word, name, amplitude, start
        cls.limits, cls.source, cls.needs = limits, source, frozenset(needs)
        cls.power, cls.neutral, cls.scaled = power, neutral, scaled
        cls.beside = frozenset(beside)
        if (word, name) in LAWS:
            raise ValueError(f"{word} {name}: there is such a law already")
        LAWS[word, name] = cls
        return cls

    return register


def make_law(word: str, name: str, values: dict[str, Any]) -> Law:
    """A law with given parameters.

    Raises
    ------
    ValueError
        There is no such law.
    """
    if (word, name) not in LAWS:
        known = ", ".join(sorted(n for w, n in LAWS if w == word)) or "none"
        raise ValueError(f"class {word!r} has no law {name!r}; it has: {known}")
    return LAWS[word, name](values=dict(values))
