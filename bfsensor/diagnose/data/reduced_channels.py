"""Channels of published or reduced data without pixels: measured a_ij, and covariances of flats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bfsensor.device.condition import Condition
from bfsensor.diagnose.data.channels import PER_ELECTRON, Channel
from bfsensor.diagnose.data.exposure_info import Axes
from bfsensor.diagnose.data.measure_channels import MeasuredChannels
from bfsensor.errors import DiagnosisError
from bfsensor.recording.tables.area_changes import AreaChangeTable
from bfsensor.recording.tables.covariance_tables import CovarianceTable
from bfsensor.response.edge_response import LEVEL
from bfsensor.typing import FloatArray


@dataclass(frozen=True, eq=False)
class StatedTable:
    """A table of a_ij with the condition and the level that it was measured at.

    Attributes
    ----------
    table : AreaChangeTable
        The a_ij.
    condition : Condition
        Light and voltages; None where they are the baseline's.
    level : float or None
        Level of the flats [e-]; where it is None, the a_ij are compared with the response at
        :data:`bfsensor.response.edge_response.LEVEL`.
    """

    table: AreaChangeTable
    condition: Condition = field(default_factory=Condition)
    level: float | None = None


def measure_reduced(
    recording: AreaChangeTable | CovarianceTable | Sequence[StatedTable], *, reach: int
) -> MeasuredChannels:
    """Turn reduced recordings into a campaign of the one channel 'flat_cov'.

    Parameters
    ----------
    recording : AreaChangeTable, CovarianceTable or sequence of StatedTable
        Table, for instance from :func:`bfsensor.recording.tables.reduced.find_reduced`, or several
        tables of a_ij of one sensor.
    reach : int
        Largest lag that the baseline predicts [pixel]; larger ones are left out.

    Returns
    -------
    MeasuredChannels
        For a_ij: unit 1/e-, no amplifier and so neither gain nor noise; (0, 0) is left out where
        it was set by the sum of the others; the axis 'table' is the index of the table.  For
        covariances: unit e-^2; each amplifier has a gain that starts at 1 and a read noise that
        starts at 0, both free.

    Raises
    ------
    DiagnosisError
        No independent value lies within the reach.
    """
    if isinstance(recording, CovarianceTable):
        return _of_covariances(recording, reach)
    if isinstance(recording, AreaChangeTable):
        recording = (StatedTable(recording),)
    return _of_areas(recording, reach)


def _of_areas(tables: Sequence[StatedTable], reach: int) -> MeasuredChannels:
    axes, notes = Axes(), []
    values, errors = [], []
    for n, stated in enumerate(tables):
        table = stated.table
        said = f"{table.path.name}: " if len(tables) > 1 else ""
        j, i = (np.asarray(index) for index in np.indices(table.a.shape))
        inside = (i <= reach) & (j <= reach)
        used = inside & table.independent & (table.errors > 0)
        if not used.any():
            raise DiagnosisError(
                f"{table.path}: no independent a_ij with an error within lags of {reach}"
            )
        own = list(table.warnings) + _beyond(~inside & np.isfinite(table.a), reach)
        without = int((inside & table.independent & ~used).sum())
        own += [f"{without} a_ij without an error"] * (without > 0)
        notes += [said + note for note in own]
        axes.add(
            int(used.sum()), stated.condition, i=i[used], j=j[used], amp=0, table=n,
            level=LEVEL if stated.level is None else stated.level, time=0,
            stated=stated.level is not None,
        )  # fmt: skip
        values.append(table.a[used])
        errors.append(table.errors[used])
    notes.append(
        "errors of a_ij are taken as independent: the table holds no covariances of them"
    )
    channel = Channel(
        "flat_cov", np.concatenate(values),
        tuple(np.square(np.concatenate(errors))[:, None, None]), axes.columns(), PER_ELECTRON,
    )  # fmt: skip
    return _measured(channel, (), notes)


def _of_covariances(table: CovarianceTable, reach: int) -> MeasuredChannels:
    inside = (table.lag_x <= reach) & (table.lag_y <= reach) & (table.level > 0)
    if not inside.any():
        raise DiagnosisError(f"{table.path}: no covariances within lags of {reach}")
    notes = list(table.warnings) + _beyond(~inside, reach)
    rows = np.flatnonzero(inside)
    names, amp = np.unique(table.amplifier[rows], return_inverse=True)
    # Amplifiers have unequal gains: levels of the same rank are one exposure level ('time').
    place = np.zeros(len(rows), np.int64)
    for n in range(len(names)):
        own = amp == n
        place[own] = np.unique(table.level[rows][own], return_inverse=True)[1]
    order = np.lexsort((table.lag_x[rows], table.lag_y[rows], place, amp))
    rows, amp, place = rows[order], amp[order], place[order]
    blocks: tuple[FloatArray, ...]
    if table.matrix is None:
        blocks = tuple(np.square(table.error[rows])[:, None, None])
    else:
        blocks = _blocks(table.matrix[np.ix_(rows, rows)], amp, place)
    axes = Axes()
    axes.add(
        len(rows), Condition(), i=table.lag_x[rows], j=table.lag_y[rows],
        amp=amp, level=table.level[rows], time=place,
    )  # fmt: skip
    columns = axes.columns() | {
        "wavelength": table.wavelength[rows], "back_bias": table.back_bias[rows],
    }  # fmt: skip
    channel = Channel("flat_cov", table.covariance[rows], blocks, columns, "electron2")
    return _measured(channel, tuple(str(n) for n in names), notes)


def _blocks(
    matrix: FloatArray, amp: NDArray[np.int64], place: NDArray[np.int64]
) -> tuple[FloatArray, ...]:
    """Cut an error matrix into amplifiers and levels; kept whole if it correlates them."""
    starts = np.flatnonzero(np.diff(amp, prepend=-1) | np.diff(place, prepend=-1))
    ends = np.append(starts[1:], len(amp))
    parts = [matrix[a:b, a:b] for a, b in zip(starts, ends, strict=True)]
    inside = sum(np.count_nonzero(p) for p in parts)
    return tuple(parts) if inside == np.count_nonzero(matrix) else (matrix,)


def _beyond(out: NDArray[np.bool_], reach: int) -> list[str]:
    count = int(out.sum())
    return [
        f"{count} values beyond lags of {reach} left out: the baseline predicts none"
    ] * (count > 0)


def _measured(
    channel: Channel, names: tuple[str, ...], notes: list[str]
) -> MeasuredChannels:
    """Campaign of one channel without positions on a sensor."""
    n = len(names)
    return MeasuredChannels(
        channels=(channel,), amplifiers=names, gains=(1.0,) * n, read_noise=(0.0,) * n,
        phases=(), columns=(0,) * n, flips=((False, False),) * n, origins=((0, 0),) * n,
        shape=(0, 0), notes=tuple(notes),
    )  # fmt: skip
