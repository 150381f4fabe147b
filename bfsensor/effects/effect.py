"""Base class of all effects: parameters, changes of pixels, and changes of measured channels.

A channel is one kind of measurement that a diagnosis compares with its prediction: means of flats
(``flat_mean``), their covariances (``flat_cov``), maps (``flat_map``), spots and so on.
"""

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
"""Stages of a readout, in the order in which light becomes codes."""

Image = NDArray[Any]
Axes = Mapping[str, NDArray]
Seen = Mapping[str, Any]


STRONG = 100.0
"""Factor on the top of an amplitude's plausible range up to which fits may go.  Chosen: the strongest
effects of campaigns by another bench are 13 times (loss of charge) and 22 times (coupling) the top;
with 1000, fits of other classes would run to strengths at which predictions overflow."""


class Parameter(NamedTuple):
    """One parameter of an effect: name, unit and plausible range.

    Parameters
    ----------
    name, unit : str
        Name and unit, as reports print them; '' without a unit.
    low, high : float
        Plausible range, of the magnitude where ``signed``.  Evidence is computed for this range;
        fits may go beyond it: amplitudes with law "log" up to a hundred times ``high``, other such
        parameters by a factor of about three, those with law "flat" by half of its width.
    neutral : float
        Value of an amplitude at which the effect changes nothing.
    law : str
        Prior of the values inside the range: "log", uniform in the logarithm; "flat", uniform;
        "whole", whole numbers and other values that are searched but not fitted.
    signed : bool
        Whether the value may have either sign.
    amplitude : bool
        True for a strength, which switches the effect off at ``neutral``; False for a parameter of
        its shape.
    step : float
        Step of numerical derivatives, in the unit of the parameter; 0: 2 % of the value for the
        law "log", 1 % of the range for "flat".
    plain : float, optional
        Value at which a more general law is the plain one; an effect that is made without this
        parameter has it.  None: the value must be given.
    ends : tuple of float
        Least and largest value that physics allows; no fit goes beyond.

    Examples
    --------
    >>> Parameter("cti", "", 1e-7, 5e-6, amplitude=True).neutral
    0.0
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
    plain: float | None = None
    ends: tuple[float, float] = (-np.inf, np.inf)

    @property
    def widest(self) -> tuple[float, float]:
        """Range of the value in fits: that of ``low`` and ``high`` widened, within the ends."""
        if self.law == "log":
            low = (
                -STRONG * self.high
                if self.signed
                else 0.0
                if self.amplitude
                else 0.3 * self.low
            )
            high = STRONG * self.high if self.amplitude else 3 * self.high
            range_ = self.neutral + low, self.neutral + high
        else:
            reach = 0.5 * (self.high - self.low)
            range_ = self.low - reach, self.high + reach
        return max(range_[0], self.ends[0]), min(range_[1], self.ends[1])


class Segment(NamedTuple):
    """One amplifier's part of the sensor, in pixels.

    Parameters
    ----------
    x, y : int
        First column and row on the sensor, from 0.
    columns, rows : int
        Size of the light-sensitive part.
    flip_x, flip_y : bool
        Whether its last column, or row, is read first.
    prescan : int
        Columns that are read before each row of the image.
    serial_overscan, parallel_overscan : int
        Columns and rows that are read after the image.

    Examples
    --------
    >>> Segment(0, 0, 4, 9, flip_x=True).sensor_column(np.arange(4))
    array([3, 2, 1, 0])
    """

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
        """Give the columns of the sensor at places in readout order.

        Parameters
        ----------
        read : ndarray of int
            Columns in the order in which the amplifier reads them, from 0, prescan not counted.

        Returns
        -------
        columns : ndarray of int
            Columns of the sensor, from 0.
        """
        return self.x + (self.columns - 1 - read if self.flip_x else read)


class Shot(NamedTuple):
    """One exposure as effects see it; nan stands for a condition that is not known.

    Parameters
    ----------
    kind : str
        'bias', 'dark', 'flat' or 'spot'.
    number : int
        Place in the order of time; -1 for no exposure in particular, but the mean of all.
    seconds : float
        Commanded exposure time [s].
    wavelength, back_bias, temperature : float
        Vacuum wavelength of the light [nm], back bias [V], temperature [K].
    hours : float
        Time since the first exposure [h].
    level : float
        Mean charge of a pixel [e-].

    Examples
    --------
    >>> Shot("flat", 3, 2.0, wavelength=620.0).back_bias
    nan
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
    """Sensor and campaign for which an effect predicts channels.

    Attributes
    ----------
    shape : tuple of int
        Rows and columns of the sensor.
    segments : tuple of Segment
        Amplifiers, in the order of the axis 'amp'.
    shots : tuple of Shot
        Exposures in the order of time.
    gains : tuple of float
        Gains of the amplifiers [e-/ADU]; empty where not known.
    offsets, read_noise : tuple of float
        Mean code without light and read noise of the amplifiers [ADU]; empty, or nan, where not
        known.
    biases : tuple of int
        Numbers of the exposures that the mean bias is made of.
    map_noise : mapping of (str, str) to float
        Variance of a map over that of a single flat, if all its flats were alike, by the name of
        the fold (part of the exposures used for cross-validation) and of the map.
    box, lags, clip : int, int, float
        Settings of the measured covariances of flats: side of the boxes whose mean is subtracted
        [pixel], largest lag [pixel], and the deviation of a pixel [sigma] beyond which it and its
        neighbours are excluded.
    reference : tuple of float
        Wavelength [nm], back bias [V] and temperature [K] of the baseline's reference condition.
    pixel, thickness : float
        Pixel pitch and thickness of the silicon [um].
    front : float
        Mean potential of the front side [V].
    absorption : mapping of float to float
        Absorption length [um] by wavelength [nm]; empty: that of silicon at 173 K.
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
    """Waves and rings detected in the maps, as starts of fits: 'map', 'shape', its parameters."""
    turn_off: float = np.inf
    """Lowest level of flats whose variance has collapsed [e-], as pixels are full; inf without."""
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
        """Give an attribute of the segments for given amplifiers.

        Parameters
        ----------
        name : str
            Attribute of :class:`Segment`.
        amp : ndarray of int
            Numbers of amplifiers.

        Returns
        -------
        values : ndarray, shape of ``amp``
            0 for a reduced recording, which has no segments.
        """
        if not self.segments:
            # A reduced recording, a table of a_ij for example, has no place on a sensor.
            return np.zeros(np.shape(amp))
        every = np.array([getattr(s, name) for s in self.segments], float)
        return np.asarray(every[np.asarray(amp).astype(int)])

    def frame_width(self, amp: NDArray) -> FloatArray:
        """Columns of the frames of given amplifiers, prescan and serial overscan included."""
        names = "prescan", "columns", "serial_overscan"
        return np.asarray(np.sum([self.of_amp(n, amp) for n in names], axis=0))

    def backwards(self, axis: str) -> float:
        """Fraction of the area whose pixels are read in falling order along ``axis``, 'x' or 'y'."""
        area = np.array([s.columns * s.rows for s in self.segments], float)
        flipped = np.array([getattr(s, f"flip_{axis}") for s in self.segments])
        return float((area * flipped).sum() / area.sum())


Halo = tuple[tuple[float, float], ...]
"""Gaussians in which parts of the light of spots are: fraction of the light, and the width that is added
in quadrature [pixel]."""


class Law(NamedTuple):
    """Departure of charge collection from boundary shifts proportional to the stored charge.

    Examples
    --------
    >>> Law(loss=1e-7).with_law(Law(loss=2e-7, full_well=1e5)).full_well
    100000.0
    >>> float(Law(losses=((1e-7, 0.5, np.inf),)).lost(1e5))
    0.01
    """

    bend: float = 0.0
    """b [1/e-]: a charge Q moves boundaries by k Q (1 + b Q / 2)."""
    loss: float = 0.0
    """q [1/e-]: light is collected with the efficiency exp(-q Q)."""
    full_well: float = np.inf
    """Charge of a pixel above which the rest spills along its column [e-]."""
    losses: tuple[tuple[float, float, float], ...] = ()
    """(q, p, K) of further losses: the efficiency is also exp(-q 1e5 (Q/1e5)^p / (1 + Q/K))."""
    drain: float = 0.0
    """Part of the charge above the full well that is lost where it spills, from 0 to 1."""

    def with_law(self, other: Law) -> Law:
        """Combine two laws: coefficients add, the lower full well holds with its drain."""
        return Law(
            self.bend + other.bend,
            self.loss + other.loss,
            min(self.full_well, other.full_well),
            self.losses + other.losses,
            self.drain if self.full_well <= other.full_well else other.drain,
        )

    @property
    def loses(self) -> bool:
        """Whether the efficiency depends on the charge."""
        return bool(self.loss or self.losses)

    def lost(self, charge: FloatArray | float) -> FloatArray:
        """Negative logarithm of the efficiency with which light is collected beside a charge [e-]."""
        full = np.maximum(np.asarray(charge, float), 0.0)
        out = self.loss * np.asarray(charge, float)
        for q, power, knee in self.losses:
            out = out + q * 1e5 * (full / 1e5) ** power / (1 + full / knee)
        return np.asarray(out)

    def light(self, charge: FloatArray) -> FloatArray:
        """Light [e-] that fills an empty pixel up to a charge [e-], shape (n,)."""
        if not self.losses:
            m = np.asarray(charge, float)
            return np.expm1(self.loss * m) / self.loss if self.loss else m
        # Nodes dense near 0, where a root of the charge rises steeply: Q = m t^2.
        nodes, weights = np.polynomial.legendre.leggauss(12)
        t = 0.5 * (nodes + 1)
        at = np.multiply.outer(np.asarray(charge, float), t * t)
        return np.asarray(np.exp(self.lost(at)) @ (weights * t) * charge)


@dataclass(frozen=True, eq=False)
class Effect:
    """One physical effect with values of its parameters; each subclass is one effect.

    An effect acts in two ways.

    *On pixels*, stage by stage, in electrons: :meth:`edges`, :meth:`law`, :meth:`light_map`,
    :meth:`displacements`, :meth:`spot_light` (predictions use these five too),
    :meth:`turbulence`, :meth:`store`, :meth:`shift`, :meth:`amplify`, :meth:`noise`,
    :meth:`convert`.

    *On channels*, in closed form: :meth:`signal`, :meth:`covariances`, :meth:`spot_image`,
    :meth:`spot_flux`, :meth:`spot_ghosts`, :meth:`pattern`, and the methods with the name of a
    channel, which return the change to be added [e-, or e-^2].  These take the axes of the
    channel, one array for each, with 'level' in electrons.  :meth:`modes` gives the random part of
    an effect that differs from exposure to exposure.

    A subclass overrides the methods of the steps that it changes; the inherited ones change nothing.

    Arguments have the same meaning in all methods: ``shot`` is the exposure with its conditions,
    ``layout`` the sensor and campaign, ``axes`` the axes of a channel by name (arrays of one entry
    for each value), ``amp`` the number of an amplifier, ``rng`` the source of random numbers.
    Images are in electrons and are not changed in place; a method that changes nothing returns its
    input.

    Parameters
    ----------
    values : mapping of str to float
        Value of every parameter that the class declares in ``parameters``, by name and in its unit.

    Raises
    ------
    EffectError
        A parameter is missing, unknown, or not finite.

    Examples
    --------
    >>> from bfsensor.effects import ChargeLoss
    >>> effect = ChargeLoss({"q": 1e-7})
    >>> effect.name, effect.is_neutral(), effect.scaled(0.0).is_neutral()
    ('charge_loss', False, True)
    """

    values: Mapping[str, float]

    word: ClassVar[str] = ""
    """Name of the class of effects in the taxonomy."""
    variant: ClassVar[str] = ""
    """Name of the kind where the taxonomy's class has several, else ''."""
    stage: ClassVar[str] = "amplifier"
    """Stage of :data:`STAGES` at which it acts on pixels."""
    parameters: ClassVar[tuple[Parameter, ...]] = ()
    """Parameters with unit and plausible range."""
    touches: ClassVar[tuple[str, ...]] = ()
    """Names of the channels that it can change."""
    source: ClassVar[str] = ""
    """Publication of its law and of the range of its parameters, or that they are assumed."""
    needs: ClassVar[tuple[str, ...]] = ()
    """Words for properties that recordings must have if the effect is to be sought: 'pixels', which
    reduced recordings do not have; 'levels', as a table of a_ij of one level could equally be that
    of another device; 'patterns', fringes or rings detected in maps, from which :meth:`starts` begin;
    'blue', covariances of flats of light whose photons can make two electrons."""
    maps_vary: ClassVar[str] = "condition"
    """With what :meth:`light_map`, :meth:`displacements` and :meth:`pattern` change: 'nothing', equal
    in all flats; 'condition', wavelength, back bias and temperature; 'exposure', also time or level."""
    response: ClassVar[str] = "linear"
    """Dependence of the changes of channels on the amplitude: 'linear'; 'quadratic', with a part of
    either order; 'rough', not smooth, so that amplitudes at starting points are kept."""
    in_images: ClassVar[bool] = True
    """Whether sensors can draw images with it; they refuse others."""
    in_areas: ClassVar[bool] = False
    """Whether tables of measured a_ij hold what :meth:`covariances` does: a share of the signal that
    moves between pixels, the same at all levels and in all amplifiers."""
    scatters: ClassVar[tuple[str, ...]] = ()
    """Channels whose scatter constrains the amplitude: :meth:`modes` are proportional to it there."""

    def __post_init__(self) -> None:
        needed = {p.name for p in self.parameters}
        plain = {p.name: p.plain for p in self.parameters if p.plain is not None}
        object.__setattr__(self, "values", plain | dict(self.values))
        if set(self.values) != needed:
            raise EffectError(
                f"{self.name}: parameters {', '.join(sorted(self.values)) or 'none'} given, "
                f"but {', '.join(sorted(needed))} needed"
            )
        for name, value in self.values.items():
            if not np.isfinite(value):
                raise EffectError(f"{self.name}: {name} = {value!r} is not finite")
        object.__setattr__(self, "values", MappingProxyType(dict(self.values)))

    def __reduce__(self) -> tuple[type[Effect], tuple[dict[str, float]]]:
        return type(self), (dict(self.values),)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Effect):
            return NotImplemented
        return self.family == other.family and self.values == other.values

    def __hash__(self) -> int:
        return hash((self.family, tuple(sorted(self.values.items()))))

    def __getitem__(self, name: str) -> float:
        return self.values[name]

    @property
    def family(self) -> Any:
        """Callable that makes this effect from values: its class, or the family with its template."""
        return type(self)

    @classmethod
    def changes(cls, *methods: str) -> bool:
        """Whether the effect has any of these methods of its own, so that it may change something."""
        return any(getattr(cls, m) is not getattr(Effect, m) for m in methods)

    @property
    def name(self) -> str:
        """Name of the class of effects, followed by ``:`` and the variant where there is one."""
        return f"{self.word}:{self.variant}" if self.variant else self.word

    @property
    def law_name(self) -> str:
        """Name of the law within the class; by default the variant, '' where the class has one law."""
        return self.variant

    def searched(self, layout: Layout) -> int:
        """Count values that a search has fitted to the same recordings and that the layout holds."""
        del layout
        return 0

    def amplitudes(self) -> tuple[str, ...]:
        """Names of the parameters that are strengths, each 0 effect at its neutral value."""
        return tuple(p.name for p in self.parameters if p.amplitude)

    def is_neutral(self) -> bool:
        """Whether every amplitude has its neutral value, so that predictions do not change by a bit."""
        return all(self[p.name] == p.neutral for p in self.parameters if p.amplitude)

    def with_values(self, **values: float) -> Self:
        """Return a copy with some parameters changed, given by name."""
        return self.family({**self.values, **values})

    def scaled(self, factor: float) -> Self:
        """Return a copy with the distance of every amplitude from neutral multiplied by ``factor``."""
        return self.with_values(**{
            p.name: p.neutral + factor * (self[p.name] - p.neutral)
            for p in self.parameters if p.amplitude
        })  # fmt: skip

    @classmethod
    def starts(cls, layout: Layout, seen: Sequence[Seen] = ()) -> list[dict[str, float]]:
        """Give values from which fits begin, so many that one leads to the best fit.

        By default amplitudes are at the middle of their range, and each parameter of the shape
        takes three values in its range, every one with every other.

        Parameters
        ----------
        layout : Layout
            Sensor and campaign.
        seen : sequence of mapping
            Places where the residuals of the baseline are significant, most significant first:
            'word' of the channel, significance 'z' [sigma], and as far as known 'x', 'y', 'amp',
            'lag', 'period' and so on.

        Returns
        -------
        starts : list of dict
            Values of all parameters, one mapping for each start.
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
        """Change the boundary shifts per electron of the baseline.

        Parameters
        ----------
        kx, ky : ndarray, shape (2 n + 1, 2 n + 1)
            Shifts of right and of upper edges [pixel/e-], [row dy, column dx] from the charge.
        shot, layout
            Conditions of the exposure; sensor and campaign.

        Returns
        -------
        kx, ky : ndarray
            Changed shifts, which may reach farther.
        """
        del shot, layout
        return kx, ky

    def level_response(
        self, shot: Shot, layout: Layout
    ) -> tuple[float, Edges, Edges] | None:
        """Give the change of the shifts with the charge in all pixels.

        Returns
        -------
        response : tuple of (float, Edges, Edges), or None
            Charge at which nothing changes [e-]; derivative of the shifts (kx, ky) by the charge
            [pixel/e-^2]; half of their second derivative [pixel/e-^3].  None: as in the baseline.
        """
        del shot, layout
        return None

    def bend_edges(self, kx: FloatArray, ky: FloatArray) -> Edges | None:
        """Give the change of the baseline's shifts per electron with the charge that causes them.

        Returns
        -------
        slopes : Edges or None
            Derivative of the shifts (kx, ky) by the charge [pixel/e-^2]: a charge Q moves boundaries
            by k Q and half of this times Q^2.  None: no change.
        """
        del kx, ky
        return None

    def law(self) -> Law:
        """Give the departure of charge collection from shifts proportional to the charge."""
        return Law()

    def light_map(self, shot: Shot, layout: Layout) -> FloatArray | None:
        """Factor on the light of an exposure, shape (ny, nx) of the sensor; None: 1 everywhere."""
        del shot, layout
        return None

    def displacements(self, shot: Shot, layout: Layout) -> Edges | None:
        """Displacements of the pixel edges without any charge [pixel].

        Of the edges between columns, shape (ny, nx + 1), towards higher columns; and between rows,
        shape (ny + 1, nx), towards higher rows; the rim of the sensor included.  None: all are 0.
        """
        del shot, layout
        return None

    def spot_light(self, shot: Shot, layout: Layout) -> tuple[float, Halo]:
        """Variance added to spots [pixel^2], and the halo that a part of their light is in."""
        del shot, layout
        return 0.0, ()

    def diffusion_growth(self, shot: Shot, layout: Layout) -> float:
        """Growth of the variance of diffusion with the charge of a pixel [pixel^2/e-], in spots."""
        del shot, layout
        return 0.0

    # -- on pixels alone

    def turbulence(
        self, shot: Shot, layout: Layout, rng: np.random.Generator
    ) -> FloatArray | None:
        """Factor on the light, random in each frame, shape (ny, nx); None: 1 everywhere."""
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

        ``memory`` holds arrays by name and is passed on from exposure to exposure; it is changed
        in place.
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
        """Levels after the errors of the analogue-to-digital converter [ADU], before rounding."""
        return levels

    # -- on channels: what is to be added to the prediction

    def pattern(self, shot: Shot, layout: Layout) -> FloatArray | None:
        """Relative change of the map of a flat by the readout, after collection; None: 0.

        Shape (ny, nx) on the axes of the sensor, not in readout order; ``shot.level`` [e-] is that
        of the flat.  Changes by :meth:`light_map` and :meth:`displacements` are not included.
        """
        del shot, layout
        return None

    def signal(self, level: FloatArray, axes: Axes, layout: Layout) -> FloatArray:
        """Signal after the amplifier [e-] of uniform light that collected the charge ``level`` [e-].

        A smooth, monotonic function of the level; it is applied to pixels of mean images of spots
        too.
        """
        del axes, layout
        return level

    def covariances(self, c: FloatArray, axes: Axes, layout: Layout) -> FloatArray:
        """Covariances of flats after this effect [e-^2].

        Parameters
        ----------
        c : ndarray, shape (n, ny, nx)
            Covariances before it, of n flats, on a periodic array with lag (0, 0) in the corner.
        axes : mapping
            Axes of the flats, arrays of shape (n,): 'amp', 'level' [e-], 'time' [s], 'hours' since
            the first exposure, and the conditions.
        layout : Layout
            Sensor and campaign.

        Returns
        -------
        covariances : ndarray, shape (n, ny, nx)
            ``c`` is not changed.
        """
        del axes, layout
        return c

    def spot_image(
        self, images: FloatArray, axes: Mapping[str, float], layout: Layout
    ) -> FloatArray:
        """Mean images of spots after this effect [e-], shape (..., ny, nx), on the sensor's axes.

        ``axes`` holds the condition, 'hours' since the first exposure, and 'background', the
        charge of a pixel beside a spot as a fraction of the spot's flux.
        """
        del axes, layout
        return images

    def spot_flux(self, axes: Axes, layout: Layout) -> FloatArray:
        """Change of the flux of whole spots [e-] by exposure, besides :meth:`spot_image`."""
        return _nothing(axes)

    def spot_ghosts(
        self, shown: FloatArray, lit: FloatArray, layout: Layout
    ) -> FloatArray | None:
        """Fractions of the charge of spots that later exposures show as ghosts at their places.

        Parameters
        ----------
        shown, lit : ndarray, shapes (n,) and (m,)
            Numbers of the exposures that show ghosts, and of those that leave them.
        layout : Layout
            Sensor and campaign.

        Returns
        -------
        parts : ndarray, shape (n, m), or None
            Fraction of the charge of each lit exposure that each other shows; None: no ghosts.
        """
        del shown, lit, layout
        return None

    def modes(self, word: str, axes: Axes, layout: Layout) -> FloatArray | None:
        """Give the random part of a channel as modes with independent strengths of variance 1.

        A random effect changes the expectation of a channel, by the other methods, and adds scatter
        of its own, which is no error of measurement and correlates values: their covariance is
        ``modes @ modes.T``.

        Parameters
        ----------
        word : str
            Name of the channel.
        axes : mapping
            Axes of its n values, and 'fold', the part of the exposures.
        layout : Layout
            Sensor and campaign.

        Returns
        -------
        modes : ndarray, shape (n, m), or None
            In the unit of the channel [e-, e-^2, or relative in maps]; None: not random.
        """
        del word, axes, layout
        return None

    def flat_mean(self, axes: Axes, layout: Layout) -> FloatArray:
        """Change of means of flats [e-], besides :meth:`signal`."""
        return _nothing(axes)

    def serial_overscan(self, axes: Axes, layout: Layout) -> FloatArray:
        """Change of the k-th pixel of the serial overscan after flats [e-], k from 1.

        The caller subtracts the zero levels: of this profile its last pixels, of the means of
        flats the second half of the overscan.
        """
        return _nothing(axes)

    def parallel_overscan(self, axes: Axes, layout: Layout) -> FloatArray:
        """Change of the k-th row of the parallel overscan after flats [e-], k from 1."""
        return _nothing(axes)

    def bias_cov(self, axes: Axes, layout: Layout) -> FloatArray:
        """Change of the covariance of the noise of biases by lag in readout order [e-^2]."""
        return _nothing(axes)

    def bias_level(self, axes: Axes, layout: Layout) -> FloatArray:
        """Change of bias levels [e-], or of their variances [e-^2].

        By the axis 'what': 'level', of the level; 'rows', of the variance of the means of rows
        above that of white noise of the same total; 'frames', of the variance of the levels of
        frames.
        """
        return _nothing(axes)

    def dark_map(self, axes: Axes, layout: Layout) -> FloatArray:
        """Change of levels and columns of darks [e-], and where 'what' is 'struck' of pixel numbers."""
        return _nothing(axes)

    def amp_cross(self, axes: Axes, layout: Layout) -> FloatArray:
        """Change of the noise shared by two amplifiers [e-^2], or of their 'crosstalk' (fraction)."""
        return _nothing(axes)

    def code_hist(self, axes: Axes, layout: Layout) -> FloatArray:
        """Change of the relative frequencies of codes in flats.

        Where 'bit' is negative, of the codes with the remainder 'code' of 64.  Where 'bit' is n,
        of the code ``-code`` below multiples of 2^n that are no multiples of 2^(n + 1), over that
        of its neighbours; 'share' is the fraction of such multiples among all multiples of 64.
        """
        return _nothing(axes)


def _nothing(axes: Axes) -> FloatArray:
    """No change of any value of a channel."""
    return np.zeros(len(next(iter(axes.values()))))
