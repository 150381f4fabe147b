"""Effects of transfer, amplifier and converter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from validation.concealed.effect import Effect, Range


def _lagged(frame, lag):
    """Return the frame as read ``lag`` pixels earlier, in readout order through all rows."""
    flat = frame.ravel()
    return np.concatenate([np.zeros(lag, flat.dtype), flat[:-lag]]).reshape(frame.shape)


def _leave_behind(frame, transfers, cti, axis):
    """Transfer losing ``cti`` each time: negative binomial delays, to the third order."""
    if cti == 0:
        return frame
    n = np.arange(1, frame.shape[axis] + 1, dtype=float) if transfers is None else transfers
    n = np.expand_dims(n, 1 - axis)
    out = frame.astype(float) * (1 - cti) ** n
    part = frame * (1 - cti) ** n
    for late in (1, 2, 3):
        part = part * (n + late - 1) / late * cti
        moved = np.roll(part, late, axis=axis)
        moved[(slice(late),) if axis == 0 else (slice(None), slice(late))] = 0
        out += moved
    return out.astype(np.float32)


@dataclass(frozen=True)
class SerialCti(Effect):
    """Each serial transfer leaves ``cti`` behind; column c of a frame takes c + 1 transfers."""

    word = "cti_serial"
    variants = {"": {"cti": Range(1e-7, 5e-6, amplitude=True)}}

    def shift(self, frames, context):
        return [_leave_behind(f, None, self.parameters["cti"], 1) for f in frames]


@dataclass(frozen=True)
class ParallelCti(Effect):
    """Each parallel transfer leaves ``cti`` behind; row r takes r + 1 transfers."""

    word = "cti_parallel"
    variants = {"": {"cti": Range(1e-7, 5e-6, amplitude=True)}}

    def shift(self, frames, context):
        return [_leave_behind(f, None, self.parameters["cti"], 0) for f in frames]


@dataclass(frozen=True)
class SerialTrap(Effect):
    """A trap at the output: fills to ``size`` e-, releases with ``tau`` pixel times.

    ``amp`` counts from zero.  In each pixel time a part 1 - exp(-1 / tau) of what is held goes
    out with the packet, which fills what is free.
    """

    word = "trap_serial"
    variants = {
        "": {
            "size": Range(5.0, 100.0, amplitude=True),
            "tau": Range(0.7, 4.0),
            "amp": Range(0, 1, "whole"),
        }
    }

    def shift(self, frames, context):
        size, tau, amp = (self.parameters[k] for k in ("size", "tau", "amp"))
        if size == 0:
            return frames
        frame = frames[int(amp) % len(frames)]
        held = np.zeros(frame.shape[0])
        released = 1 - np.exp(-1 / tau)
        out = np.empty_like(frame)
        # every row meets an empty trap: the parallel transfer takes far longer than tau
        for c in range(frame.shape[1]):
            free = held * released
            packet = frame[:, c]
            held = held - free
            caught = np.clip(np.minimum(packet, size - held), 0, None)
            out[:, c] = packet - caught + free
            held = held + caught
        frames = list(frames)
        frames[int(amp) % len(frames)] = out
        return frames


@dataclass(frozen=True)
class ElectronicMemory(Effect):
    """``alpha`` of the previous pixel is added to each, in readout order."""

    word = "electronic_memory"
    variants = {"": {"alpha": Range(1e-5, 1e-3, amplitude=True)}}

    def amplifier(self, frames, context):
        alpha = np.float32(self.parameters["alpha"])
        return [f + alpha * _lagged(f, 1) for f in frames]


@dataclass(frozen=True)
class Crosstalk(Effect):
    """``c`` of every other amplifier's signal is added, at the same pixel time."""

    word = "amp_crosstalk"
    variants = {"": {"c": Range(1e-5, 1e-3, signed=True, amplitude=True)}}

    def amplifier(self, frames, context):
        c = np.float32(self.parameters["c"])
        total = sum(frames)
        return [f + c * (total - f) for f in frames]


@dataclass(frozen=True)
class CorrelatedNoise(Effect):
    """Noise beside the white one: ``rms`` [e-], correlated in time or between amplifiers.

    ar1: each pixel keeps ``corr`` of the last; common: the same in all amplifiers; pickup: a
    sine of ``period`` pixels, its phase free in each frame.
    """

    word = "correlated_noise"
    variants = {
        "ar1": {"rms": Range(0.5, 4.0, amplitude=True), "corr": Range(0.3, 0.95, "flat")},
        "common": {"rms": Range(0.5, 4.0, amplitude=True)},
        "pickup": {"rms": Range(0.3, 3.0, amplitude=True), "period": Range(5.0, 60.0)},
    }

    def noise(self, frames, context):
        stream = context.stream(self.word)
        rms = self.parameters["rms"]
        shape = frames[0].shape
        if self.variant == "common":
            return _add(frames, [rms * stream.standard_normal(shape)] * len(frames))
        if self.variant == "pickup":
            time = np.arange(frames[0].size).reshape(shape)
            phase = stream.random()
            wave = np.sin(2 * np.pi * (time / self.parameters["period"] + phase))
            return _add(frames, [rms * np.sqrt(2) * wave] * len(frames))
        keep = self.parameters["corr"]
        fresh = [stream.standard_normal(f.size) * np.sqrt(1 - keep**2) for f in frames]
        return _add(
            frames, [rms * lfilter([1], [1, -keep], n).reshape(shape) for n in fresh]
        )


def _add(frames, noises):
    return [f + n.astype(np.float32) for f, n in zip(frames, noises, strict=True)]


@dataclass(frozen=True)
class BiasInstability(Effect):
    """The bias moves: from frame to frame or row to row by ``rms`` [e-], or along rows.

    ramp: ``amp`` [e-] at the first pixel of each row, falling with ``length`` pixels.
    """

    word = "bias_instability"
    variants = {
        "frame": {"rms": Range(0.3, 10.0, amplitude=True)},
        "row": {"rms": Range(0.3, 3.0, amplitude=True)},
        "ramp": {"amp": Range(2.0, 30.0, amplitude=True), "length": Range(5.0, 60.0)},
    }

    def noise(self, frames, context):
        stream = context.stream(self.word)
        rows, columns = frames[0].shape
        if self.variant == "ramp":
            fall = np.exp(-np.arange(columns) / self.parameters["length"])[None, :]
            return _add(frames, [self.parameters["amp"] * fall] * len(frames))
        shape = (rows, 1) if self.variant == "row" else (1, 1)
        rms = self.parameters["rms"]
        return _add(frames, [rms * stream.standard_normal(shape) for _ in frames])


@dataclass(frozen=True)
class GainNonlinearity(Effect):
    """Signal S becomes S (1 + c2 S/1e5 + c3 (S/1e5)^2), S in e-."""

    word = "gain_nonlinearity"
    variants = {
        "": {
            "c2": Range(1e-3, 2e-2, signed=True, amplitude=True),
            "c3": Range(3e-4, 5e-3, signed=True, amplitude=True),
        }
    }

    def amplifier(self, frames, context):
        c2, c3 = (np.float32(self.parameters[k]) for k in ("c2", "c3"))
        return [
            f * (1 + c2 * (f / np.float32(1e5)) + c3 * (f / np.float32(1e5)) ** 2)
            for f in frames
        ]


@dataclass(frozen=True)
class AdcBits(Effect):
    """The weight of bit ``bit`` is off by ``delta`` codes: codes are skipped or too wide."""

    word = "adc_bits"
    variants = {
        "": {
            "delta": Range(0.2, 2.0, signed=True, amplitude=True),
            "bit": Range(2, 9, "whole"),
        }
    }

    def converter(self, levels, context):
        delta, bit = self.parameters["delta"], int(self.parameters["bit"])
        if delta == 0:
            return levels
        out = []
        for level in levels:
            # successive approximation with one wrong weight
            left = np.clip(level + 0.5, 0, 65535.999)
            code = np.zeros(level.shape)
            for k in range(15, -1, -1):
                weight = 2.0**k + (delta if k == bit else 0.0)
                on = left >= weight
                left = left - np.where(on, weight, 0.0)
                code += np.where(on, 2.0**k, 0.0)
            out.append(code)
        return out


@dataclass(frozen=True)
class GainDrift(Effect):
    """The signal in ADU grows by ``slope`` per hour."""

    word = "gain_drift"
    variants = {"": {"slope": Range(5e-4, 2e-2, signed=True, amplitude=True)}}

    def gain(self, context):
        return 1 + self.parameters["slope"] * context.exposure.hours


READOUT_EFFECTS = (
    SerialCti,
    ParallelCti,
    SerialTrap,
    ElectronicMemory,
    Crosstalk,
    CorrelatedNoise,
    BiasInstability,
    GainNonlinearity,
    AdcBits,
    GainDrift,
)
