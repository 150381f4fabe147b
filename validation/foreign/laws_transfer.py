"""Laws of transfer: proportional losses and traps, along the serial register and the columns.

Frames are in readout order; a packet at frame column i (prescan counted) has been moved i + 1 times
along the register, one at frame row j has been moved j + 1 times down.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import comb

from validation.foreign.collection import Image
from validation.foreign.law import Law, law
from validation.foreign.plan import LAMP

FULL = 1e5
"""Charge [e-] at which trapping laws are normalised."""


def leave_behind(packets: Image, cti: float, most: int = 6) -> Image:
    """Lose a fraction ``cti`` to the packet behind at each transfer.

    After n transfers C(n - 1 + k, k) cti^k (1 - cti)^n of a packet are k places behind; what is
    more than ``most`` behind is put at ``most``.

    Parameters
    ----------
    packets : ndarray, shape (transfers, lines)
        Along axis 0 packet i has i + 1 transfers.

    Examples
    --------
    >>> q = np.zeros((6, 1)); q[3] = 1000.0
    >>> leave_behind(q, 1e-2)[:, 0].round(2).tolist()
    [0.0, 0.0, 0.0, 960.6, 38.42, 0.96]
    """
    n = np.arange(1, len(packets) + 1, dtype=float)[:, None]
    out = np.zeros_like(packets)
    left = np.ones_like(n)
    for k in range(most + 1):
        share = comb(n - 1 + k, k) * cti**k * (1 - cti) ** n if k < most else left
        left = left - share
        moved = (packets * share.astype(packets.dtype))[: len(packets) - k]
        out[k:] += moved
    return out


def trap(
    packets: Image,
    capacity: list,
    tau: list[float],
) -> Image:
    """Traps that fill at once and release with time constants ``tau`` [packets].

    Parameters
    ----------
    packets : ndarray, shape (transfers, lines)
    capacity : list of callable
        For each species, takes (packet number, charge) and gives the charge that traps hold when
        that packet passes.
    """
    out = packets.copy()
    held = [np.zeros(packets.shape[1], packets.dtype) for _ in tau]
    stay = [np.float32(np.exp(-1 / t)) for t in tau]
    for i in range(len(out)):
        q = out[i]
        for s in range(len(tau)):
            free = held[s] * (1 - stay[s])
            held[s] = held[s] - free
            q = q + free
            wanted = np.minimum(
                np.maximum(capacity[s](i, q) - held[s], 0), np.maximum(q, 0)
            )
            held[s] = held[s] + wanted
            q = q - wanted
        out[i] = q
    return out


class _SerialAxis(Law):
    """Works along rows: packets along axis 1 of a frame."""

    def packets(self, packets: Image, number: int) -> Image:
        raise NotImplementedError

    def serial(self, frame, number, exposure):
        return np.ascontiguousarray(self.packets(np.ascontiguousarray(frame.T), number).T)


class _ParallelAxis(Law):
    """Works along columns."""

    def packets(self, packets: Image, number: int) -> Image:
        raise NotImplementedError

    def parallel(self, frame, number, exposure):
        return self.packets(frame, number)


class _Proportional(Law):
    def packets(self, packets, number):
        return leave_behind(packets, self.values["cti"]) if self.values["cti"] else packets


class _VolumeFilling(Law):
    """Traps fill with the volume of the packet: capacity n cti 1e5 (S / 1e5)^beta."""

    def species(self) -> list[tuple[float, float]]:
        return [(1.0, self.values["tau"])]

    def packets(self, packets, number):
        cti, beta = self.values["cti"], self.values["beta"]
        if not cti:
            return packets

        def make(share):
            def capacity(i, q):
                fill = (np.maximum(q, 0) / np.float32(FULL)) ** np.float32(beta)
                return np.float32((i + 1) * cti * FULL * share) * fill

            return capacity

        species = self.species()
        return trap(packets, [make(share) for share, _ in species], [t for _, t in species])

    @staticmethod
    def one_species(rng):
        return {
            "beta": float(round(rng.uniform(0.35, 0.85), 3)),
            "tau": float(round(rng.uniform(0.6, 6.0), 3)),
        }


class _TwoTimes(_VolumeFilling):
    def species(self):
        v = self.values
        return [(1 - v["share2"], v["tau"]), (v["share2"], v["tau2"])]

    @staticmethod
    def two_species(rng):
        return {
            "beta": float(round(rng.uniform(0.4, 1.0), 3)),
            "tau": float(round(rng.uniform(0.4, 1.5), 3)),
            "tau2": float(round(rng.uniform(4.0, 15.0), 3)),
            "share2": float(round(rng.uniform(0.2, 0.7), 3)),
        }


_SERIAL = {"needs": ("serial_overscan",), "limits": (1e-9, 1e-3)}


@law(
    "cti_serial",
    "proportional",
    amplitude="cti",
    start=2e-07,
    source="Janesick 2001, section 5.3 (deferred charge); Snyder & Roodman 2019 "
    "(JATIS 5, 041509): proportional loss",
    **_SERIAL,
)
class SerialProportional(_Proportional, _SerialAxis):
    """A fraction cti is left behind at each serial transfer."""


@law(
    "cti_serial",
    "volume_filling",
    amplitude="cti",
    start=6e-07,
    source="Massey et al. 2014 (MNRAS 439, 887), trapped charge ~ (S/w)^beta; "
    "Short et al. 2013 (MNRAS 430, 3078, CDM): volume ~ S^beta",
    **_SERIAL,
)
class SerialVolumeFilling(_VolumeFilling, _SerialAxis):
    """Traps in every register pixel fill as S^beta and release exp(-1/tau) for each pixel."""

    draw = classmethod(lambda cls, rng, setting: cls.one_species(rng))


@law(
    "cti_serial",
    "two_time_constants",
    amplitude="cti",
    start=6e-07,
    source="Massey et al. 2014 and ArCTIc: several species of traps with release "
    "times of their own",
    **_SERIAL,
)
class SerialTwoTimes(_TwoTimes, _SerialAxis):
    """Two species in every register pixel, the second slow."""

    draw = classmethod(lambda cls, rng, setting: cls.two_species(rng))


_PARALLEL = {"needs": ("parallel_overscan",), "limits": (1e-9, 1e-3)}


@law(
    "cti_parallel",
    "proportional",
    amplitude="cti",
    start=2e-07,
    source="Janesick 2001, section 5.3: extended pixel edge response along columns",
    **_PARALLEL,
)
class ParallelProportional(_Proportional, _ParallelAxis):
    """A fraction cti is left behind at each parallel transfer."""


@law(
    "cti_parallel",
    "volume_filling",
    amplitude="cti",
    start=6e-07,
    source="Massey et al. 2014; Short et al. 2013 (CDM), parallel direction",
    **_PARALLEL,
)
class ParallelVolumeFilling(_VolumeFilling, _ParallelAxis):
    """Traps in every pixel of a column fill as S^beta."""

    draw = classmethod(lambda cls, rng, setting: cls.one_species(rng))


@law(
    "cti_parallel",
    "two_time_constants",
    amplitude="cti",
    start=6e-07,
    source="Massey et al. 2014: three species in HST's columns, here two",
    **_PARALLEL,
)
class ParallelTwoTimes(_TwoTimes, _ParallelAxis):
    """Two species in every pixel, the second slow."""

    draw = classmethod(lambda cls, rng, setting: cls.two_species(rng))


class _OneTrap(_SerialAxis):
    """One trap in the register of one amplifier (``amp``, from 0), at a register pixel."""

    def fill(self, q: Image) -> Image:
        """Charge that the trap holds at a packet's charge, for size 1 [e-]."""
        raise NotImplementedError

    def species(self):
        return [(1.0, self.values["tau"])]

    @classmethod
    def place(cls, rng, setting):
        lay = setting.layout
        return {
            "amp": int(rng.integers(0, lay.amplifiers)),
            "column": int(lay.prescan + rng.integers(1, max(lay.width // 2, 2))),
            "tau": float(round(rng.uniform(0.5, 5.0), 3)),
        }

    def packets(self, packets, number):
        v = self.values
        if number != v["amp"] or not v["size"]:
            return packets
        at, out = int(v["column"]), packets.copy()
        size = np.float32(v["size"])

        def make(share):
            return lambda i, q: size * np.float32(share) * self.fill(q)

        species = self.species()
        out[at:] = trap(
            packets[at:], [make(s) for s, _ in species], [t for _, t in species]
        )
        return out


_TRAP = {"needs": ("serial_overscan",), "limits": (0.3, 4000.0)}


@law(
    "trap_serial",
    "linear_capture",
    amplitude="size",
    start=8.0,
    source="Snyder et al. 2021 (JATIS 7, 048002), section 3: local trap, captures "
    "scaling x S up to its size; release exp(-1/tau)",
    **_TRAP,
)
class TrapLinear(_OneTrap):
    """Captures in proportion to the charge until it is full at ``full`` electrons."""

    @classmethod
    def draw(cls, rng, setting):
        return {**cls.place(rng, setting), "full": float(round(rng.uniform(500, 8e4)))}

    def fill(self, q):
        return np.clip(q / np.float32(self.values["full"]), 0, 1)


@law(
    "trap_serial",
    "logistic_capture",
    amplitude="size",
    start=8.0,
    source="Snyder et al. 2021, section 3: logistic trap, size / (1 + exp(-k (S - f0)))",
    **_TRAP,
)
class TrapLogistic(_OneTrap):
    """Captures from packets above ``f0`` electrons, over a width 1/k."""

    @classmethod
    def draw(cls, rng, setting):
        return {
            **cls.place(rng, setting),
            "f0": float(round(rng.uniform(5e3, 6e4))),
            "width": float(round(rng.uniform(1e3, 8e3))),
        }

    def fill(self, q):
        x = np.clip((q - self.values["f0"]) / self.values["width"], -30, 30)
        # none from an empty packet
        low = 1 / (1 + np.exp(self.values["f0"] / self.values["width"]))
        return np.maximum((1 / (1 + np.exp(-x)) - low) / (1 - low), 0).astype(np.float32)


@law(
    "trap_serial",
    "volume_two_times",
    amplitude="size",
    start=10.0,
    source="Massey et al. 2014 (volume filling) with two release times as in "
    "Snyder et al. 2021's fits of several traps",
    **_TRAP,
)
class TrapVolume(_OneTrap):
    """Fills as (S / 1e5)^beta; releases with two time constants."""

    @classmethod
    def draw(cls, rng, setting):
        return {
            **cls.place(rng, setting),
            "beta": float(round(rng.uniform(0.4, 0.9), 3)),
            "tau2": float(round(rng.uniform(4, 12), 3)),
            "share2": float(round(rng.uniform(0.2, 0.7), 3)),
        }

    def species(self):
        v = self.values
        return [(1 - v["share2"], v["tau"]), (v["share2"], v["tau2"])]

    def fill(self, q: NDArray):
        return (np.maximum(q, 0) / np.float32(FULL)) ** np.float32(self.values["beta"])


# -------------------------------------------------------------------- stored charge
class _Coupling(Law):
    """Neighbours share a fraction of their signal, the same at all signals."""

    def kernel(self):
        """Fractions by (dx, dy), for both directions of each axis."""
        raise NotImplementedError

    def stored(self, charge, exposure):
        out = charge.copy()
        for (dx, dy), f in self.kernel().items():
            if f:
                f = np.float32(f)
                out += f * (np.roll(charge, (dy, dx), (0, 1)) - charge)
        return out


@law(
    "interpixel_coupling",
    "four_neighbours",
    amplitude="ax",
    start=0.004,
    limits=(1e-05, 0.08),
    source="Moore, Ninkov & Forrest 2006 (Opt. Eng. 45, 076402): capacitive "
    "coupling to four neighbours",
)
class CouplingFour(_Coupling):
    """ax to each neighbour in x, ay in y."""

    @classmethod
    def draw(cls, rng, setting):
        return {"ratio": float(round(np.exp(rng.uniform(-1.5, 1.5)), 3))}

    def settle(self):
        self.values["ay"] = self.values.get("ax", 0.0) * self.values.get("ratio", 1.0)

    def kernel(self):
        ax, ay = self.values["ax"], self.values["ay"]
        return {(1, 0): ax, (-1, 0): ax, (0, 1): ay, (0, -1): ay}


@law(
    "interpixel_coupling",
    "extended",
    amplitude="ax",
    start=0.004,
    limits=(1e-05, 0.05),
    source="Donlon et al. 2016 and Giannini et al. 2013: coupling reaches diagonal"
    " and second neighbours; here ax decay^(r - 1)",
)
class CouplingExtended(_Coupling):
    """Coupling falls by a factor for each pixel of distance, over 5 x 5 pixels."""

    @classmethod
    def draw(cls, rng, setting):
        return {"decay": float(round(rng.uniform(0.08, 0.35), 3))}

    def settle(self):
        self.values["ay"] = self.values.get("ax", 0.0)

    def kernel(self):
        ax, decay = self.values["ax"], self.values["decay"]
        reach = [(i, j) for i in range(-2, 3) for j in range(-2, 3) if i or j]
        return {(i, j): ax * decay ** (np.hypot(i, j) - 1) for i, j in reach}


class _FullWell(Law):
    """Full well below what the brightest flats hold, by the fraction ``depth`` of it."""

    def settle(self):
        if self.setting is None:
            return
        top = LAMP * max(self.setting.plan.levels)
        self.values["full_well"] = float(top * (1 - self.values.get("depth", 0.0)))

    def truth(self):
        return {k: v for k, v in super().truth().items() if k != "depth"}


_WELL = {"amplitude": "depth", "start": 0.1, "limits": (0.01, 0.5), "scaled": False}


@law(
    "saturation",
    "hard_clip",
    source="Janesick 2001, section 2.3: surface full well with anti-blooming "
    "drain; what is above is lost",
    **_WELL,
)
class HardClip(_FullWell):
    """Charge above full_well is lost."""

    def stored(self, charge, exposure):
        if not self.values["depth"]:
            return charge
        return np.minimum(charge, np.float32(self.values["full_well"]))


@law(
    "saturation",
    "blooming",
    source="Janesick 2001, section 2.3: blooming full well; excess runs along the "
    "column, charge is conserved",
    **_WELL,
)
class Blooming(_FullWell):
    """Excess runs to both neighbours along the column until none holds more than full_well."""

    rounds = 400

    def stored(self, charge, exposure):
        if not self.values["depth"]:
            return charge
        well, q = np.float32(self.values["full_well"]), charge.copy()
        for _ in range(self.rounds):
            over = np.maximum(q - well, 0)
            if over.max() < 1:
                break
            q -= over
            q[1:] += 0.5 * over[:-1]
            q[:-1] += 0.5 * over[1:]
        return q


@law(
    "saturation",
    "spill_back",
    source="Lage et al. 2017 and catalogue item 15: the barrier falls gradually, a"
    " share of what lies above moves to neighbours before clipping",
    **_WELL,
)
class SpillBack(_FullWell):
    """A share of charge above full_well goes to the column's neighbours; the rest is kept softly."""

    @classmethod
    def draw(cls, rng, setting):
        return {"share": float(round(rng.uniform(0.3, 0.7), 3))}

    def stored(self, charge, exposure):
        if not self.values["depth"]:
            return charge
        well = np.float32(self.values["full_well"])
        over = np.maximum(charge - well, 0) * np.float32(self.values["share"])
        q = charge - over
        # into neighbours that have room, softly limited where they have none
        q[1:] += 0.5 * over[:-1]
        q[:-1] += 0.5 * over[1:]
        above = np.maximum(q - well, 0)
        return np.minimum(q, well) + 0.15 * well * np.tanh(above / (0.15 * well))
