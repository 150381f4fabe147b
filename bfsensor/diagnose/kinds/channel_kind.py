"""Base class of the kinds of channels: all that a diagnosis knows of one kind of measurement."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from bfsensor.diagnose.data.channel_rows import Rows
from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.data.measure_channels import MeasuredChannels
from bfsensor.diagnose.kinds.scan_templates import Group, Pattern
from bfsensor.effects.effect import Axes, Effect, Layout
from bfsensor.typing import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes as Panel

Draw = Callable[["Panel"], Any]


class Picture(NamedTuple):
    """One figure: caption, size (width, height) [inch], and panels drawn one below the other."""

    caption: str
    size: tuple[float, float]
    parts: tuple[Draw, ...]


class ChannelModel(Protocol):
    """Model at given parameters, as kinds of channels ask it."""

    @property
    def noise(self) -> FloatArray:
        """Variance of the read noise by amplifier [ADU^2]."""

    def covariances(self, channel: Channel) -> FloatArray:
        """Covariances of flats, with all effects."""

    def spots(self, channel: Channel) -> FloatArray:
        """Widths, fluxes and wings of spots, with all effects."""

    def map_change(self, channel: Channel) -> FloatArray:
        """Change of maps by all effects."""

    def added(self, channel: Channel) -> FloatArray:
        """Change of a channel by all effects, each by its method with the channel's name."""


class ChannelKind:
    """One kind of channels; each subclass says how it is predicted, scanned and drawn.

    A subclass overrides what differs: by default a channel is predicted to be 0, effects add to it
    what their methods with its name return, nothing linear is fitted, and no figure is drawn.

    Attributes
    ----------
    name : str
        Name of the channel.
    title : str
        Plain words for it, in reports.
    level : str
        Axis of the signal level; scans state the interval that holds most of their weight.
    """

    name: str
    title: str
    level = "level"

    def depends(self, channel: Channel, *, changed: bool) -> tuple[str, ...]:
        """Kinds of the parameters, besides the effects', that predictions depend on.

        ``changed`` states whether an effect changes the channel, in electrons.
        """
        del channel, changed
        return ()

    def predict(self, channel: Channel, model: ChannelModel) -> FloatArray:
        """Predict a channel without its linear parameters, in its unit, shape (n,)."""
        return model.added(channel)

    def change(self, effect: Effect, axes: Axes, layout: Layout) -> FloatArray:
        """Change by an effect [e-, or e-^2], shape (n,); ``axes`` with levels in electrons."""
        if self.name not in effect.touches:
            return np.zeros(len(next(iter(axes.values()))))
        return np.asarray(getattr(effect, self.name)(axes, layout))

    def in_unit(self, change: FloatArray, own: FloatArray, axes: Axes) -> FloatArray:
        """Change of the values from their change in ADU; ``own`` is each value's gain [e-/ADU]."""
        del own, axes
        return change

    def columns(
        self, channel: Channel, rows: Rows, measured: MeasuredChannels
    ) -> dict[str, FloatArray]:
        """Make the columns of the linear parameters: change of the channel for a unit of each.

        The same name is the same parameter in all channels: the light by amplifier and condition,
        the dark current, the shape of the light, the flux of the spots.

        Parameters
        ----------
        channel : Channel
            Channel to make columns for.
        rows : dict
            Indices of its values by condition.
        measured : MeasuredChannels
            Channels of the campaign, for its amplifiers.

        Returns
        -------
        dict of str to ndarray
            Columns in the channel's unit, by name.
        """
        del channel, rows, measured
        return {}

    def patterns(self, g: Group) -> Iterator[Pattern]:
        """Patterns in which residuals are scanned, in the unit of the channel, over all folds."""
        raise NotImplementedError(f"{self.name} has no scans")

    def fitted_patterns(self, g: Group, residuals: FloatArray) -> Iterator[Pattern]:
        """Patterns that depend on the fit, from its whitened residuals."""
        del g, residuals
        yield from ()

    def picture(self, channel: Channel, pulls: FloatArray) -> Picture | None:
        """Figure of the pulls (residuals over errors) of a channel; None without one."""
        del channel, pulls
        return None
