"""What an effect is: parameters, what it does to pixels, and what it does to each channel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from bfsensor.errors import EffectError
from bfsensor.typing import Edges, FloatArray

STAGES = ("light", "collect", "store", "shift", "amplifier", "converter")
"""In the order in which light becomes codes."""

Image = NDArray[Any]
Axes = Mapping[str, NDArray]
Seen = Mapping[str, Any]


class Parameter(NamedTuple):
    """One number of an effect.

    Attributes
    ----------
    name, unit : str
        As the report has them.
    low, high : float
        Ends of the range that is plausible, of the magnitude where ``signed``; fits may leave
        it by a factor of ten, evidence is counted inside it.
    neutral : float
        Of an amplitude: the value at which nothing changes.
    law : str
        "log" or "flat": how plausible values are spread; "whole": whole numbers.
    signed : bool
        Either sign.
    amplitude : bool
        Whether the effect is off at ``neutral``; other parameters are of its shape.
    step : float
        Of derivatives; 0: after the range.
    """

    name: str
    unit: str
    low: float
    high: float
    neutral: float = 0.0
    law: str = "log"
    signed: bool = False
    amplitude: bool = False
    step: float = 0.0


class Segment(NamedTuple):
    """One amplifier's part of the sensor [pixel]; its overscans are read after it."""

    x: int
    y: int
    columns: int
    rows: int
    flip_x: bool = False
    flip_y: bool = False
    prescan: int = 0
    serial_overscan: int = 0
    parallel_overscan: int = 0

    def sensor_column(self, read: NDArray[Any]) -> NDArray[Any]:
        """Columns of the sensor that are read as such of the amplifier, from 0."""
        return self.x + (self.columns - 1 - read if self.flip_x else read)


class Shot(NamedTuple):
    """What an effect may know of one exposure; nan where not known.

    Attributes
    ----------
    kind : str
        'bias', 'dark', 'flat' or 'spot'.
    number : int
        Place in the order of time.
    seconds : float
        Commanded exposure time [s].
    wavelength, back_bias, temperature : float
        [nm], [V], [K].
    hours : float
        Since the first exposure [h].
    level : float
        Mean charge of a pixel [e-].
    """

    kind: str
    number: int
    seconds: float
    wavelength: float = np.nan
    back_bias: float = np.nan
    temperature: float = np.nan
    hours: float = 0.0
    level: float = 0.0


@dataclass(frozen=True)
class Layout:
    """Sensor and campaign that predictions are made for.

    Attributes
    ----------
    shape : tuple of int
        Rows and columns of the sensor.
    segments : tuple of Segment
        Amplifiers, in the order of the axis 'amp'.
    shots : tuple of Shot
        Exposures in the order of time.
    gains : tuple of float
        Of the amplifiers [e-/ADU].
    offsets, read_noise : tuple of float
        Mean code without light and read noise of the amplifiers [ADU]; empty, or nan, where not
        known.
    biases : tuple of int
        Numbers of the exposures that the mean bias is made of.
    map_noise : mapping of (str, str) to float
        By fold and name of a map: its variance over that of a single flat, were all flats of it
        alike.
    sightings : tuple of mapping
        What the maps were searched for as a whole, for starts: 'map', 'shape' and its numbers.
    box, lags, clip : int, int, float
        Of the flats' covariances: side of the boxes whose means are taken off and largest lag
        [pixel], and the deviation [sigma] from which a pixel is left out, its neighbours too.
    reference : tuple of float
        Wavelength [nm], back bias [V] and temperature [K] that a baseline is given for.
    pixel, thickness : float
        Pitch and thickness [um].
    front : float
        Mean voltage of the front side [V].
    absorption : mapping of float to float
        Absorption length [um] by wavelength [nm].
    """

    shape: tuple[int, int]
    segments: tuple[Segment, ...]
    shots: tuple[Shot, ...] = ()
    gains: tuple[float, ...] = ()
    reference: tuple[float, float, float] = (620.0, -60.0, 173.15)
    pixel: float = 10.0
    thickness: float = 100.0
    front: float = 8.0
    absorption: Mapping[float, float] = field(default_factory=dict)
    offsets: tuple[float, ...] = ()
    read_noise: tuple[float, ...] = ()
    biases: tuple[int, ...] = ()
    map_noise: Mapping[tuple[str, str], float] = field(default_factory=dict)
    sightings: tuple[Seen, ...] = ()
    box: int = 64
    lags: int = 4
    clip: float = 5.0

    @property
    def noise(self) -> FloatArray:
        """Read noise of the amplifiers [e-], 0 where not known."""
        if len(self.read_noise) != len(self.segments) or not self.gains:
            return np.zeros(len(self.segments))
        return np.nan_to_num(np.array(self.read_noise) * np.array(self.gains))

    def of_amp(self, name: str, amp: NDArray) -> FloatArray:
        """Give an attribute of the segments, by name, of given amplifiers."""
        if not self.segments:
            # A reduced recording: nothing of it lies anywhere on a sensor.
            return np.zeros(np.shape(amp))
        every = np.array([getattr(s, name) for s in self.segments], float)
        return np.asarray(every[np.asarray(amp).astype(int)])

    def frame_width(self, amp: NDArray) -> FloatArray:
        """Columns of given amplifiers' frames, prescan and overscan among them."""
        names = "prescan", "columns", "serial_overscan"
        return np.asarray(np.sum([self.of_amp(n, amp) for n in names], axis=0))

    def backwards(self, axis: str) -> float:
        """Share of the light that is read against an axis, 'x' or 'y'."""
        area = np.array([s.columns * s.rows for s in self.segments], float)
        flipped = np.array([getattr(s, f"flip_{axis}") for s in self.segments])
        return float((area * flipped).sum() / area.sum())


class Law(NamedTuple):
    """How collection departs from shifts that are proportional to the stored charge.

    Attributes
    ----------
    bend : float
        b: boundaries move by k Q (1 + b Q / 2) [1/e-].
    loss : float
        q: light is collected with exp(-q Q) [1/e-].
    full_well : float
        Charge beyond which it spills along the column [e-].
    """

    bend: float = 0.0
    loss: float = 0.0
    full_well: float = np.inf

    def with_law(self, other: Law) -> Law:
        """Both together."""
        return Law(
            self.bend + other.bend,
            self.loss + other.loss,
            min(self.full_well, other.full_well),
        )


@dataclass(frozen=True)
class Effect:
    """One piece of physics with its parameters; subclasses say what it does.

    Two faces.  *On pixels*, stage by stage, in electrons: :meth:`edges`, :meth:`law`,
    :meth:`light_map`, :meth:`displacements`, :meth:`spot_light` (they serve predictions too),
    :meth:`turbulence`, :meth:`store`, :meth:`shift`, :meth:`amplify`, :meth:`noise`,
    :meth:`convert`.  *On channels*, in closed form: :meth:`signal`, :meth:`covariances`,
    :meth:`spot_image`, :meth:`spot_flux`, :meth:`spot_ghosts`, :meth:`pattern` and the methods
    named after channel words, which give the change that is to be added, in electrons (or e-^2),
    and are given the axes of the channel with 'level' in electrons; :meth:`modes` says what is
    left to chance.  A subclass overrides what it touches and nothing else.

    Parameters
    ----------
    values : mapping of str to float
        All parameters.

    Raises
    ------
    EffectError
        A parameter is missing, unknown, or not finite.

    Attributes
    ----------
    word, variant : str
        Class in the taxonomy, and which kind of it where there are several.
    stage : str
        Of :data:`STAGES`.
    parameters : tuple of Parameter
    touches : tuple of str
        Channel words that can change.
    source : str
        Where the law and the range come from.
    by_time : bool
        Whether :meth:`light_map`, :meth:`displacements` or :meth:`pattern` change with the
        exposure time or the level.
    standing : bool
        Whether :meth:`light_map`, :meth:`displacements` and :meth:`pattern` are the same in all
        flats.
    from_sightings : bool
        Whether :meth:`starts` are taken from waves that were sought in maps.
    of_pixels : bool
        Whether its predictions need the amplifiers' pixels, which reduced recordings do not tell.
    of_levels : bool
        Whether only the level tells it: a_ij without one are as well those of another device.
    bends : bool
        Whether what it changes goes with the square of its amplitude as well.
    told_by_scatter : tuple of str
        Channels in which :meth:`modes`, in proportion to the amplitude, tell how strong it is.
    """

    values: Mapping[str, float]

    word: ClassVar[str] = ""
    variant: ClassVar[str] = ""
    stage: ClassVar[str] = "amplifier"
    parameters: ClassVar[tuple[Parameter, ...]] = ()
    touches: ClassVar[tuple[str, ...]] = ()
    source: ClassVar[str] = ""
    by_time: ClassVar[bool] = False
    standing: ClassVar[bool] = False
    of_pixels: ClassVar[bool] = False
    of_levels: ClassVar[bool] = False
    from_sightings: ClassVar[bool] = False
    bends: ClassVar[bool] = False
    told_by_scatter: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        needed = {p.name for p in self.parameters}
        if set(self.values) != needed:
            raise EffectError(
                f"{self.name}: parameters {', '.join(sorted(self.values)) or 'none'} given, "
                f"{', '.join(sorted(needed))} needed"
            )
        for name, value in self.values.items():
            if not np.isfinite(value):
                raise EffectError(f"{self.name}: {name} = {value!r} is not finite")
        object.__setattr__(self, "values", MappingProxyType(dict(self.values)))

    def __reduce__(self) -> tuple[type[Effect], tuple[dict[str, float]]]:
        return type(self), (dict(self.values),)

    def __hash__(self) -> int:
        return hash((type(self), tuple(sorted(self.values.items()))))

    def __getitem__(self, name: str) -> float:
        return self.values[name]

    @property
    def name(self) -> str:
        """Class, and variant where there are several."""
        return f"{self.word}:{self.variant}" if self.variant else self.word

    @classmethod
    def amplitudes(cls) -> tuple[str, ...]:
        """Names of the parameters that switch the effect off."""
        return tuple(p.name for p in cls.parameters if p.amplitude)

    def is_neutral(self) -> bool:
        """Whether every amplitude has its neutral value: nothing changes by a bit."""
        return all(self[p.name] == p.neutral for p in self.parameters if p.amplitude)

    def with_values(self, **values: float) -> Self:
        """Copy with some parameters changed."""
        return type(self)({**self.values, **values})

    def scaled(self, factor: float) -> Self:
        """Copy with every amplitude's distance from neutral multiplied."""
        return self.with_values(**{
            p.name: p.neutral + factor * (self[p.name] - p.neutral)
            for p in self.parameters if p.amplitude
        })  # fmt: skip

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        """Give places where a fit may begin, one of which leads to the best fit.

        By default amplitudes at the middle of their range and three places of each shape
        parameter's range, crossed.

        Parameters
        ----------
        layout : Layout
            Sensor and campaign.
        seen : sequence of mapping
            Where the baseline fails, farthest first: 'word' of the channel, 'z', and what the
            scan found: 'x', 'y', 'amp', 'lag', 'period' ... as far as it says.
        """
        del layout, seen
        grids: list[dict[str, float]] = [{}]
        for p in cls.parameters:
            middle = (
                float(np.sqrt(p.low * p.high)) if p.law == "log" else (p.low + p.high) / 2
            )
            places = [p.neutral + middle]
            if not p.amplitude and p.law == "log":
                places = [float(v) for v in np.geomspace(p.low, p.high, 5)[1:4]]
            elif not p.amplitude and p.law == "flat":
                places = [float(p.low + f * (p.high - p.low)) for f in (0.2, 0.5, 0.8)]
            elif not p.amplitude:
                places = [float(v) for v in range(int(p.low), int(p.high) + 1)]
            grids = [{**g, p.name: v} for g in grids for v in places]
        return grids

    # -- light and collection: on pixels and in predictions alike

    def edges(self, kx: FloatArray, ky: FloatArray, shot: Shot, layout: Layout) -> Edges:
        """Shifts of right and upper edges per electron [pixel/e-], [row dy, column dx]."""
        del shot, layout
        return kx, ky

    def level_response(
        self, shot: Shot, layout: Layout
    ) -> tuple[float, Edges, Edges] | None:
        """Give how shifts change with the charge that is there; None: no other than the baseline's.

        Returns
        -------
        level : float
            Charge at which nothing changes [e-].
        slope, bend : tuple of ndarray
            Change per electron [pixel/e-^2], and half the second derivative [pixel/e-^3].
        """
        del shot, layout
        return None

    def law(self) -> Law:
        """How collection departs from linear shifts."""
        return Law()

    def light_map(self, shot: Shot, layout: Layout) -> FloatArray | None:
        """Factor on the light of an exposure, shape of the sensor; None: one."""
        del shot, layout
        return None

    def displacements(self, shot: Shot, layout: Layout) -> Edges | None:
        """Standing displacements [pixel] of the edges between columns and between rows.

        Shapes (ny, nx + 1) and (ny + 1, nx), the rim's edges too; None: they stand.
        """
        del shot, layout
        return None

    def spot_light(self, shot: Shot, layout: Layout) -> tuple[float, float, float]:
        """Of spots: added variance [pixel^2], share of light in a halo, its sigma [pixel]."""
        del shot, layout
        return 0.0, 0.0, 1.0

    # -- on pixels alone

    def turbulence(
        self, shot: Shot, layout: Layout, rng: np.random.Generator
    ) -> FloatArray | None:
        """Factor on the light that differs from frame to frame; None: one."""
        del shot, layout, rng
        return None

    def store(
        self,
        charge: Image,
        shot: Shot,
        layout: Layout,
        rng: np.random.Generator,
        memory: dict[str, NDArray],
    ) -> Image:
        """Charge as it is stored [e-], shape of the sensor.

        ``memory`` is kept from exposure to exposure.
        """
        del shot, layout, rng, memory
        return charge

    def shift(self, frame: Image, amp: int, layout: Layout) -> Image:
        """Frame of an amplifier after transfer [e-], readout order, overscans included."""
        del amp, layout
        return frame

    def amplify(self, frames: list[Image], shot: Shot, layout: Layout) -> list[Image]:
        """Frames of all amplifiers after the amplifier [e-]."""
        del shot, layout
        return frames

    def noise(
        self, frames: list[Image], layout: Layout, rng: np.random.Generator
    ) -> list[Image]:
        """Frames with noise and offsets added [e-]."""
        del layout, rng
        return frames

    def convert(self, levels: Image) -> Image:
        """Levels as the converter's wrong steps show them [ADU], before rounding."""
        return levels

    # -- on channels: what is to be added to the prediction

    def pattern(self, shot: Shot, layout: Layout) -> FloatArray | None:
        """Relative change of a flat's map that comes after collection; None: none.

        Shape of the sensor, on its axes (not in readout order); ``shot.level`` [e-] is the
        flat's.  What :meth:`light_map` and :meth:`displacements` change is not to be given again.
        """
        del shot, layout
        return None

    def signal(self, level: FloatArray, axes: Axes, layout: Layout) -> FloatArray:
        """Signal of smooth light after the amplifier [e-] against the collected charge [e-].

        One to one and smooth; also of pixels of spots' mean images.
        """
        del axes, layout
        return level

    def covariances(self, c: FloatArray, axes: Axes, layout: Layout) -> FloatArray:
        """Covariances of flats after this effect [e-^2].

        Parameters
        ----------
        c : ndarray, shape (n, ny, nx)
            Periodic, lag (0, 0) in the corner, by flat.
        axes : mapping
            Of the flats, shape (n,): 'amp', 'level' [e-], 'time' [s], 'hours' since the first
            exposure, conditions.
        layout : Layout
            Of the sensor.
        """
        del axes, layout
        return c

    def spot_image(
        self, images: FloatArray, axes: Mapping[str, float], layout: Layout
    ) -> FloatArray:
        """Mean images of spots [e-] on the sensor's axes after this effect, shape (..., ny, nx).

        ``axes``: the condition, 'hours', and 'background', electrons of a pixel beside a spot over
        the spot's flux.
        """
        del axes, layout
        return images

    def spot_flux(self, axes: Axes, layout: Layout) -> FloatArray:
        """Added to electrons of whole spots [e-], besides :meth:`spot_image`; by exposure."""
        return _nothing(axes)

    def spot_ghosts(
        self, shown: FloatArray, lit: FloatArray, layout: Layout
    ) -> FloatArray | None:
        """Parts of the charge of spots that others show where they were.

        Parameters
        ----------
        shown, lit : ndarray, shapes (n,) and (m,)
            Numbers of the exposures that show ghosts, and of those that leave them.
        layout : Layout
            Sensor and campaign.

        Returns
        -------
        parts : ndarray, shape (n, m), or None
            None: nothing is left.
        """
        del shown, lit, layout
        return None

    def modes(self, word: str, axes: Axes, layout: Layout) -> FloatArray | None:
        """What chance adds to a channel: shapes whose strengths are independent, of variance 1.

        A random effect changes values in expectation, by the other methods, and by its own
        scatter, which is no error of measurement and ties values together.

        Parameters
        ----------
        word : str
            Channel.
        axes : mapping
            Of its n values, and 'fold'.
        layout : Layout
            Sensor and campaign.

        Returns
        -------
        modes : ndarray, shape (n, m), or None
            In the unit of the change [e-, or e-^2, or relative in maps]; None: no chance.
        """
        del word, axes, layout
        return None

    def flat_mean(self, axes: Axes, layout: Layout) -> FloatArray:
        """Added to means of flats [e-], besides :meth:`signal`."""
        return _nothing(axes)

    def serial_overscan(self, axes: Axes, layout: Layout) -> FloatArray:
        """Added to the k-th pixel of the serial overscan behind flats [e-].

        The profile's zero, its last pixels, is taken off by the caller, and so is the zero of
        the means of flats, the overscan's second half.
        """
        return _nothing(axes)

    def parallel_overscan(self, axes: Axes, layout: Layout) -> FloatArray:
        """Added to the k-th row of the parallel overscan behind flats [e-]."""
        return _nothing(axes)

    def bias_cov(self, axes: Axes, layout: Layout) -> FloatArray:
        """Added to the noise's covariance at a lag in readout order [e-^2]."""
        return _nothing(axes)

    def bias_level(self, axes: Axes, layout: Layout) -> FloatArray:
        """Added to bias levels [e-], or to variances [e-^2].

        Where 'what' is 'rows': to the variance of rows' means over that of white noise of the
        same total; where it is 'frames': to that of frames' levels.
        """
        return _nothing(axes)

    def dark_map(self, axes: Axes, layout: Layout) -> FloatArray:
        """Added to levels and columns of darks [e-]; where 'what' is 'struck', to numbers."""
        return _nothing(axes)

    def amp_cross(self, axes: Axes, layout: Layout) -> FloatArray:
        """Added to shared noise [e-^2]; where 'what' is 'crosstalk', to fractions."""
        return _nothing(axes)

    def code_hist(self, axes: Axes, layout: Layout) -> FloatArray:
        """Added to the relative frequencies of codes.

        By remainder; where 'bit' is n > 0, of the ``-code``-th code below those that 2^n is the
        highest power of two in, over its neighbours', 'share' being the part that those make of
        all multiples of 64.
        """
        return _nothing(axes)


def _nothing(axes: Axes) -> FloatArray:
    return np.zeros(len(next(iter(axes.values()))))
