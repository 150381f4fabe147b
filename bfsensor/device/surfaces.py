"""Heights of gates and silicon across a pixel, from the oxides of a device."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from bfsensor.typing import FloatArray

if TYPE_CHECKING:
    from bfsensor.device.device import Device

SILICON_CONSUMED = 4.0 / 9.0
"""Share of a grown oxide that lies below the silicon surface it was grown from.

Derived from the molar volumes of Si and SiO2, which give 0.44 (Deal & Grove 1965, J. Appl. Phys.
36, 3770); 4/9 puts the gate of the published ITL device at its 0.5 um above the field-oxide top."""


@dataclass(frozen=True)
class Surfaces:
    """Heights of gate and silicon in the channel and in the channel stop [um].

    The field oxide has its top at z = 0; a share :data:`SILICON_CONSUMED` of the difference
    between field and gate oxide lies below the silicon surface of the channel.

    Attributes
    ----------
    gate_channel : float
        Height of the gate's lower face in the channel [um].
    silicon_channel, silicon_stop : float
        Heights of the silicon surface in the channel and in the channel stop [um].
    stop_half_width : float
        Half the width of the channel stop [um].
    taper, side_diffusion : float
        Widths over which the oxide, and the stop's implants, change beyond that [um].
    """

    gate_channel: float
    silicon_channel: float
    silicon_stop: float
    stop_half_width: float
    taper: float
    side_diffusion: float

    @classmethod
    def of(cls, device: Device) -> Surfaces:
        """Take the surfaces from a device."""
        gates, stop = device.gates, device.channel_stop
        gate = (1.0 - SILICON_CONSUMED) * (gates.field_oxide - gates.gate_oxide)
        gate = max(gate, 0.0)
        return cls(
            gate,
            gate + gates.gate_oxide,
            gates.field_oxide,
            stop.width / 2,
            gates.field_oxide_taper,
            stop.side_diffusion,
        )

    def ramp(self, distance: FloatArray, width: float) -> FloatArray:
        """Rise from 0 in the channel stop to 1 in the channel, against distance from the edge."""
        beyond = distance - self.stop_half_width
        if width <= 0:
            # Round-off must not decide on which side a mesh node on the edge lies.
            return np.where(beyond > 1e-9, 1.0, 0.0)
        return np.clip(beyond / width, 0.0, 1.0)

    def gate(self, distance: FloatArray) -> FloatArray:
        """Height of the gate's lower face [um]."""
        return self.gate_channel * self.ramp(distance, self.taper)

    def silicon(self, distance: FloatArray) -> FloatArray:
        """Height of the silicon surface [um]."""
        return self.silicon_stop + (self.silicon_channel - self.silicon_stop) * self.ramp(
            distance, self.taper
        )
