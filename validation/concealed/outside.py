"""Real mismatches that no class of the taxonomy describes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from validation.concealed.collect import transform
from validation.concealed.effect import Effect, Range
from validation.concealed.effects_readout import _lagged
from validation.concealed.electrostatics import WINDOW, EdgeShifts


@dataclass(frozen=True)
class OutsideLibrary(Effect):
    """Seven kinds, told by the variant.

    axes_exchanged
        The baseline's x and y are exchanged: shifts of the true device, ``amp`` (1) of the way to
        their transposes.
    odd_kernel
        Edges move by a further ``amp`` of their shift, towards +x on either side of a charge:
        flats see nothing to first order, spots wander with flux.
    echo
        ``amp`` S^2 / 1e5 e- of the pixel read seven pixel times before is added.
    sign_flip
        Edges two pixels from a charge move by ``amp`` Q (1 - Q / turning): the covariance at lag
        two turns its sign with flux.
    checkerboard
        Signal S of odd and even pixels (row plus column) differs by amp S^2 / 1e5.
    ripple
        Signal is modulated by ``amp`` as a sine of ``period`` pixel times, phase locked.
    last_level
        The gain falls by ``amp`` per 1e5 e- of the previous exposure's mean level.
    """

    word = "outside_library"
    variants = {
        "axes_exchanged": {"amp": Range(1.0, 1.0, amplitude=True)},
        "odd_kernel": {"amp": Range(0.02, 0.4, signed=True, amplitude=True)},
        "echo": {"amp": Range(1e-4, 5e-3, signed=True, amplitude=True)},
        "sign_flip": {
            "amp": Range(1e-8, 1e-7, signed=True, amplitude=True),
            "turning": Range(4e4, 1e5, "flat"),
        },
        "checkerboard": {"amp": Range(2e-4, 5e-3, signed=True, amplitude=True)},
        "ripple": {"amp": Range(2e-4, 5e-3, amplitude=True), "period": Range(7.0, 40.0)},
        "last_level": {"amp": Range(1e-3, 1e-2, signed=True, amplitude=True)},
    }

    def shifts(self, shifts, context):
        if self.variant == "axes_exchanged":
            amp = self.parameters["amp"]
            return EdgeShifts(
                shifts.kx + amp * (shifts.ky.T - shifts.kx),
                shifts.ky + amp * (shifts.kx.T - shifts.ky),
            )
        if self.variant == "odd_kernel":
            return EdgeShifts(
                shifts.kx + self.parameters["amp"] * np.abs(shifts.kx), shifts.ky
            )
        return shifts

    def laws(self, context):
        if self.variant != "sign_flip" or not self.parameters["amp"]:
            return {}
        side = 2 * WINDOW + 1
        kx, ky = np.zeros((2, side, side))
        # right edges of the second and of the first pixel to either side
        for edge, sign in ((1, -1.0), (-2, 1.0)):
            kx[WINDOW, WINDOW + edge] = sign * self.parameters["amp"]
            ky[WINDOW + edge, WINDOW] = sign * self.parameters["amp"]
        pixels = context.geometry.pixels
        return {
            "extra_kx": transform(kx, pixels),
            "extra_ky": transform(ky, pixels),
            "turning": self.parameters["turning"],
        }

    def store(self, charge, context):
        if self.variant != "checkerboard":
            return charge
        index = np.indices(charge.shape, dtype=np.int32).sum(axis=0)
        sign = (1 - 2 * (index % 2)).astype(np.float32)
        half = np.float32(self.parameters["amp"] / 2 / 1e5)
        return charge + half * sign * charge * charge

    def amplifier(self, frames, context):
        if self.variant == "echo":
            amp = np.float32(self.parameters["amp"] / 1e5)
            return [f + amp * _lagged(f, 7) ** 2 for f in frames]
        if self.variant == "ripple":
            time = np.arange(frames[0].size).reshape(frames[0].shape)
            wave = np.sin(2 * np.pi * time / self.parameters["period"])
            factor = (1 + self.parameters["amp"] * wave).astype(np.float32)
            return [f * factor for f in frames]
        if self.variant == "last_level":
            level = context.memory.get(self.word)
            context.memory[self.word] = np.array(np.mean([f.mean() for f in frames]))
            if level is not None:
                factor = np.float32(1 - self.parameters["amp"] * float(level) / 1e5)
                return [f * factor for f in frames]
        return frames
