"""Prediction of the channel of spots by condition, from shifts, widths without charge and effects."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from copy import copy
from functools import partial

import numpy as np
from numpy.typing import NDArray

from bfsensor.device.condition import Condition
from bfsensor.diagnose.data.channel_rows import Rows, condition_of_row
from bfsensor.diagnose.data.channels import Channel
from bfsensor.diagnose.data.exposure_info import label_of
from bfsensor.diagnose.data.measure_channels import MeasuredChannels
from bfsensor.diagnose.data.spot_places import widening
from bfsensor.diagnose.model.baseline import Baseline
from bfsensor.diagnose.model.effect_chain import EffectChain
from bfsensor.diagnose.model.spot_predictions import predict_spots, representative_phases
from bfsensor.errors import DiagnosisError
from bfsensor.typing import Edges, FloatArray

Found = dict[str, FloatArray]
"""Predicted quantities of spots, by name."""


class SpotPredictor:
    """Predicts the channel of spots; their widths without charge are free parameters.

    The optics depend on wavelength, and diffusion on temperature, neither of which a baseline
    describes: each pair has a free width in x and in y.  A change of the width with back bias at
    one temperature is not free, so that it can be found as an effect.

    Parameters
    ----------
    measured : MeasuredChannels
        Channels of the campaign, for its conditions and the places of its spots.
    baseline : Baseline
        Boundary shifts.

    Attributes
    ----------
    widths : list of str
        Wavelength and temperature of each width, such as '620/-100' [nm, C].
    start : list of float
        Start values of the widths along x and y in turn [pixel].
    """

    def __init__(self, measured: MeasuredChannels, baseline: Baseline) -> None:
        self.measured, self.baseline = measured, baseline
        self.widths: list[str] = []
        self.start: list[float] = []
        self._slopes: Edges | None = None
        self._gained: FloatArray | None = None
        self._kept: dict[Condition, tuple[tuple[NDArray, ...], Found]] = {}
        self._places: dict[int, FloatArray] = {}
        phases: dict[Condition, list[FloatArray]] = {}
        places = iter(measured.phases)
        for channel in (c for c in measured.channels if c.word == "spot"):
            for row in np.nonzero(channel.axes["what"] == "sigma_x")[0]:
                condition = condition_of_row(channel, row)
                own = next(places)
                phases.setdefault(condition, []).append(own)
                self._places[int(channel.axes["exposure"][row])] = own
                if width_of(condition) not in self.widths:
                    self.widths.append(width_of(condition))
                    self.start += [float(v) for v in channel.values[row : row + 2]]
        self._phases = {
            k: representative_phases(np.concatenate(p)) for k, p in phases.items()
        }

    def with_baseline(self, baseline: Baseline, slopes: Edges | None) -> SpotPredictor:
        """Make a copy with another baseline; ``slopes`` apply where the baseline has none for spots."""
        other = copy(self)
        other.baseline, other._kept = baseline, {}
        if slopes is not None:
            other._slopes = slopes
        return other

    def with_conditions(self, conditions: Iterable[Condition]) -> SpotPredictor:
        """Make a copy that also predicts spots at further conditions.

        Spots have the places within their pixels of others of the same wavelength and temperature.

        Raises
        ------
        DiagnosisError
            The campaign has no spots of that wavelength and temperature, so that their width
            without charge is unknown.
        """
        other = copy(self)
        other._phases = dict(self._phases)
        for condition in conditions:
            if condition in other._phases:
                continue
            width = width_of(condition)
            like = next((c for c in self._phases if width_of(c) == width), None)
            if like is None:
                raise DiagnosisError(
                    f"spots at wavelength/temperature {width} [nm/C]: their width without charge is "
                    f"known at {', '.join(self.widths) or 'none'} only"
                )
            other._phases[condition] = self._phases[like]
        return other

    def predict(
        self,
        channel: Channel,
        rows_of: Rows,
        gains: FloatArray,
        device: Mapping[str, float],
        sigmas: FloatArray,
        *,
        only: str | None = None,
        chain: EffectChain | None = None,
    ) -> FloatArray:
        """Predict a channel of spots without its linear parameters.

        Parameters
        ----------
        channel : Channel
            Channel of spots.
        rows_of : dict
            Indices of its values by condition.
        gains : ndarray
            Gains of the amplifiers [e-/ADU].
        device : mapping of str to float
            Device parameters less their nominal values, in their units.
        sigmas : ndarray, shape (2 widths,)
            Widths without charge [pixel], x and y in turn.
        only : str, optional
            One of ``widths``: other spots are not predicted, and have the value 0.
        chain : EffectChain, optional
            Effects added to the baseline.

        Returns
        -------
        ndarray, shape (n,)
            Prediction in the unit of each value.
        """
        x = channel.axes
        # Images were converted to electrons with rough gains: scale fluxes to the fitted ones.
        scale = float(np.mean(gains / np.array(self.measured.gains)))
        out = np.zeros(len(channel))
        for condition in self._phases:
            rows = rows_of.get(condition, np.zeros(0, int))
            width = width_of(condition)
            if not len(rows) or (only is not None and width != only):
                continue
            n = self.widths.index(width)
            edges, slopes = self._shifts(condition, device)
            sigma = float(sigmas[2 * n]), float(sigmas[2 * n + 1])
            fluxes = scale * x["flux"][rows]
            if chain is None or chain.leaves_spots:
                state = (*edges, np.array(sigma), fluxes)
                found = dict(self._unchanged(condition, state, slopes))
            else:
                found = self._changed(
                    condition, edges, slopes, sigma, fluxes, chain, _axes(x, rows),
                    self._places_of(x["exposure"][rows]),
                )  # fmt: skip
            found["flux"] = found["flux"] / scale
            for what, values in found.items():
                here = x["what"][rows] == what
                out[rows[here]] = values[here]
        if chain is not None:
            here = x["what"] == "flux"
            axes = {k: v[here] for k, v in x.items()} | {"flux": scale * x["flux"][here]}
            out[here] += chain.spot_flux(axes) / scale
            self._add_ghosts(out, x, chain)
        return out

    def _add_ghosts(
        self, out: FloatArray, x: Mapping[str, NDArray], chain: EffectChain
    ) -> None:
        """Add to fluxes and widths the charge that earlier spots of all folds left behind."""
        placed = self.measured.placed
        lit = np.array([s.number for s in placed], float)
        fluxes = np.array([s.flux for s in placed])
        place_of = {s.number: n for n, s in enumerate(placed)}
        for what in ("flux", "sigma_x", "sigma_y"):
            rows = np.flatnonzero(x["what"] == what)
            numbers = x["exposure"][rows].astype(int)
            parts = chain.spot_ghosts(numbers.astype(float), lit)
            if parts is None or not len(placed):
                return
            if what == "flux":
                out[rows] += parts @ fluxes
                continue
            # Planned exposures have no places yet, others no prediction: their widths do not change.
            known = np.isin(numbers, list(place_of)) & (out[rows] > 0)
            rows, own = rows[known], [place_of[n] for n in numbers[known].tolist()]
            if self._gained is None:
                self._gained = widening(placed, placed)
            shares = parts[known] * fluxes / fluxes[own, None]
            gained = (shares * self._gained["xy".index(what[-1]), own]).sum(1)
            out[rows] += gained / (2 * out[rows])

    def _places_of(self, numbers: NDArray) -> list[FloatArray] | None:
        """Places of the spots of exposures within their pixels; None if any is planned only."""
        found = [self._places.get(int(n)) for n in numbers]
        return (
            None if any(f is None for f in found) else [f for f in found if f is not None]
        )

    def _shifts(
        self, condition: Condition, device: Mapping[str, float]
    ) -> tuple[Edges, Edges | None]:
        """Shifts of spots at zero charge, and their slopes with charge, if there are any."""
        (kx, ky), _ = self.baseline.at(condition, device)
        key = self.baseline.nearest(condition)
        if not self.baseline.spots_bend or key not in self.baseline.slopes:
            return (kx, ky), self._slopes
        # Slopes of nonparametric terms are part of the baseline's here.
        sx, sy = self.baseline.slopes[key]
        level = self.baseline.level
        return (kx - level * sx, ky - level * sy), (sx, sy)

    def _unchanged(
        self,
        condition: Condition,
        state: tuple[FloatArray, ...],
        slopes: Edges | None,
    ) -> Found:
        """Spots that no effect changes, at a condition; cached while only effects' parameters change."""
        kept = self._kept.get(condition)
        if kept is None or not all(map(np.array_equal, kept[0], state)):
            kx, ky, sigma, fluxes = state
            found = predict_spots(
                kx, ky, sigma=(float(sigma[0]), float(sigma[1])), phases=self._phases[condition],
                fluxes=fluxes, slopes=slopes,
            )  # fmt: skip
            kept = self._kept[condition] = state, found
        return kept[1]

    def _changed(
        self,
        condition: Condition,
        edges: Edges,
        slopes: Edges | None,
        sigma: tuple[float, float],
        fluxes: FloatArray,
        chain: EffectChain,
        given: Mapping[str, float],
        places: Sequence[FloatArray] | None,
    ) -> Found:
        """Spots with effects, at a condition; ``given`` are axes for effects after collection."""
        variance, halo, axes = chain.spot_change(condition)
        wide = sigma
        if variance:
            squares = [max(s * s + variance, 0.01 * s * s) for s in sigma]
            wide = float(np.sqrt(squares[0])), float(np.sqrt(squares[1]))
        edges, slopes = chain.spot_edges(edges, slopes, condition)
        return predict_spots(
            *edges, sigma=wide,
            phases=self._phases[condition], fluxes=fluxes, halo=halo, law=chain.law,
            neighbours=self.measured.neighbours, slopes=slopes,
            growth=chain.diffusion_growth(condition),
            change=partial(chain.spot_image, axes={**axes, **given}), places=places,
        )  # fmt: skip


def width_of(condition: Condition) -> str:
    """Wavelength and temperature of a condition, such as '620/-100' [nm, C], which share a width."""
    wavelength, _, temperature = label_of(condition).split("/")
    return f"{wavelength}/{temperature}"


def _axes(x: Mapping[str, NDArray], rows: NDArray[np.int64]) -> dict[str, float]:
    """Mean time [h] of a condition's exposures, and background per electron of flux."""
    out = {}
    if "hours" in x:
        out["hours"] = float(np.mean(x["hours"][rows]))
    if "background" in x:
        # Dark current grows with the time that the flux takes.
        out["background"] = float(x["background"][rows].sum() / x["flux"][rows].sum())
    return out
