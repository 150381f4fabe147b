"""One symmetric multigrid V-cycle as a preconditioner, in single precision.

Columns are relaxed exactly along z, red and black in x and y, and only x and y are
coarsened: near the gates cells are far thinner than wide, deep in the bulk the reverse,
and this smoother does not care (Trottenberg et al. 2001, Multigrid, section 5.1).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bfsensor._kernels import colour_sweeps, relaxation
from bfsensor.simulate.discretise import Coefficients, dual_widths, link_factors
from bfsensor.typing import FloatArray

_COARSEST_SWEEPS = 6
"""Red-black sweeps on the coarsest mesh, in each of the two orders that keep the cycle symmetric.

Chosen: with these a cycle about halves the error (``tests/simulate/test_poisson.py``); twice as many
solve the coarsest mesh more exactly, at little cost where it has few columns."""

_PINNED = 1e12
"""Link that holds a coarse node inside a conductor at 0 V [e-/V per um of row width].

Chosen: links of silicon are some 1e3 and 1e12 times that is far from the end of single precision;
twice as strong, such a node is held at half the error, which is 1e-9 of its neighbours'."""


@dataclass
class _Level:
    coefficients: dict[str, NDArray]
    carriers: NDArray[np.float32]
    solution: NDArray[np.float32]
    charge: NDArray[np.float32]
    pivots: NDArray[np.float32]
    work: NDArray[np.float32]
    weight_x: NDArray[np.float32]
    weight_y: NDArray[np.float32]
    columns: int
    periodic: tuple[bool, bool]


class Multigrid:
    """The hierarchy of one :class:`~bfsensor.simulate.discretise.Coefficients`.

    Parameters
    ----------
    fine : Coefficients
        The finest operator, without carriers.
    """

    def __init__(self, fine: Coefficients) -> None:
        self.levels: list[_Level] = []
        level: Coefficients | None = fine
        while level is not None:
            coarser = _coarsen(level)
            self.levels.append(_make_level(level))
            level = coarser
        nz, ny, nx = fine.mesh.shape
        self._out = np.zeros((ny + 2, nz, nx + 2), np.float32)
        self.set_carriers(np.zeros_like(self.levels[0].carriers))
        self.cycles = 0

    def set_carriers(self, carriers: NDArray[np.floating]) -> None:
        """Set the derivative of the mobile charge [e-/V] in the front planes, on every level."""
        self.levels[0].carriers[...] = carriers
        for upper, lower in zip(self.levels[:-1], self.levels[1:], strict=True):
            relaxation.fill_halo(upper.carriers, *upper.periodic)
            relaxation.restrict(
                upper.carriers, upper.weight_x, upper.weight_y, lower.carriers
            )
        for level in self.levels:
            c = level.coefficients
            colour_sweeps.eliminate(
                level.carriers, c["cy"], c["cz"], c["centre"], c["kind"], c["north"], c["south"],
                c["inverse_dy"], level.pivots,
            )  # fmt: skip

    def cycle(self, charge: FloatArray) -> NDArray[np.float32]:
        """Solve ``A out = charge`` approximately; the next cycle writes to the same array."""
        self.cycles += 1
        top = self.levels[0]
        colour_sweeps.packed(charge, top.charge)
        self._cycle(0)
        colour_sweeps.unpacked(top.solution, self._out)
        return self._out

    def _cycle(self, depth: int) -> None:
        level = self.levels[depth]
        c = level.coefficients
        rows = c["kind"], c["north"], c["south"]
        columns = (
            level.solution, level.charge, level.pivots, c["left"], c["right"], c["cy"], c["cz"],
        )  # fmt: skip
        if depth == len(self.levels) - 1:
            level.solution[...] = 0.0
            for first in (0, 1):
                for n in range(2 * _COARSEST_SWEEPS):
                    colour_sweeps.relax(
                        *columns, *rows, c["inverse_dy"], (first + n) % 2, level.columns,
                        *level.periodic, level.work, False,
                    )  # fmt: skip
            return
        lower = self.levels[depth + 1]
        weights = level.weight_x, level.weight_y
        colour_sweeps.descend(
            *columns, *rows, c["dy"], c["inverse_dy"], level.columns, *weights, *level.periodic,
            level.work, lower.charge,
        )  # fmt: skip
        self._cycle(depth + 1)
        colour_sweeps.ascend(
            *columns, *rows, c["inverse_dy"], level.columns, *weights, *level.periodic, level.work,
            lower.solution,
        )  # fmt: skip


def _make_level(fine: Coefficients) -> _Level:
    mesh = fine.mesh
    nz, ny, nx = mesh.shape
    half = (nx + 1) // 2
    single = np.float32
    cz_below = np.zeros_like(fine.cz)
    cz_below[:, 1:] = fine.cz[:, :-1]
    cx_left = np.zeros_like(fine.cx)
    cx_left[:, :, 1:] = fine.cx[:, :, :-1]
    centre = fine.cx + cx_left + fine.cz + cz_below + fine.cd
    inverse_dy = np.zeros(ny + 2, single)
    inverse_dy[1:-1] = 1.0 / fine.dy[1:-1]
    coefficients: dict[str, NDArray] = {
        "centre": _packed(centre, 1.0),
        "left": _packed(cx_left),
        "right": _packed(fine.cx),
        "cy": _packed(fine.cy),
        "cz": _packed(fine.cz),
        "kind": fine.kind,
        "north": fine.north.astype(single),
        "south": fine.south.astype(single),
        "dy": fine.dy.astype(single),
        "inverse_dy": inverse_dy,
    }
    return _Level(
        coefficients=coefficients,
        carriers=np.zeros((ny + 2, fine.n_front, nx + 2), single),
        solution=np.zeros((ny + 2, 2, nz, half + 2), single),
        charge=np.zeros((ny + 2, 2, nz, half), single),
        pivots=np.zeros((ny + 2, 2, nz, half), single),
        work=np.zeros((nz, nx // 2 + 6), single),
        weight_x=interpolation_weights(mesh.x, mesh.side_x, mesh.period[0]).astype(single),
        weight_y=interpolation_weights(mesh.y, mesh.side_y, mesh.period[1]).astype(single),
        columns=nx,
        periodic=(mesh.side_x == "periodic", mesh.side_y == "periodic"),
    )


def _packed(field: FloatArray, rest: float = 0.0) -> NDArray[np.float32]:
    """Columns of odd number, then of even; where there is none of the latter, ``rest``."""
    kinds, nz, nx = field.shape
    out = np.full((kinds, 2, nz, (nx - 1) // 2), rest, np.float32)
    colour_sweeps.packed(field.astype(np.float32), out)
    return out


def interpolation_weights(nodes: FloatArray, side: str, period: float) -> FloatArray:
    """Weight of the upper coarse neighbour of every fine node between two, with halo.

    Fine node ``f`` (counted from the halo) is coarse where ``f`` is odd; the halo gets
    the weight of its periodic image, or none.
    """
    out = np.zeros(len(nodes) + 2)
    extended = np.concatenate([nodes, [nodes[0] + period]]) if side == "periodic" else nodes
    middle = extended[1:-1:2]
    lower, upper = extended[0:-2:2], extended[2::2]
    count = min(len(middle), len(upper))
    out[2 : 2 * count + 1 : 2] = (middle[:count] - lower[:count]) / (
        upper[:count] - lower[:count]
    )
    if side == "periodic":
        out[0] = out[-2]
    else:
        # Nothing lies beyond a mirror plane: its halo must not be interpolated from.
        out[0] = 0.0
        if len(nodes) % 2 == 0:
            out[-2] = 0.0
        out[-1] = 1.0
    return out


def _can_halve(count: int, side: str) -> bool:
    return (
        count % 2 == 0 and count >= 8
        if side == "periodic"
        else count % 2 == 1 and count >= 5
    )


def _coarsen(fine: Coefficients) -> Coefficients | None:
    """The operator on every second node in x and y; None where that is not possible."""
    mesh = fine.mesh
    nz, ny, nx = mesh.shape
    if not (_can_halve(nx, mesh.side_x) and _can_halve(ny, mesh.side_y)):
        return None
    coarse_mesh = replace(mesh, x=mesh.x[::2], y=mesh.y[::2], cells=mesh.cells // 2)
    weights = interpolation_weights(mesh.x, mesh.side_x, mesh.period[0])
    conductor = np.zeros((fine.cx.shape[0], nz, len(coarse_mesh.x) + 2), bool)
    conductor[:, :, 1:-1] = fine.conductor[:, :, 1:-1][:, :, ::2]
    if mesh.side_x == "periodic":
        conductor[:, :, 0], conductor[:, :, -1] = conductor[:, :, -2], conductor[:, :, 1]
    free = ~conductor

    def gather(a: FloatArray) -> FloatArray:
        out = np.zeros_like(conductor, dtype=float)
        centre = a[:, :, 1:-1][:, :, ::2]
        n = centre.shape[2]
        left = (weights * a)[:, :, 0:-2:2][:, :, :n]
        right = ((1.0 - weights) * a)[:, :, 2::2][:, :, :n]
        out[:, :, 1:-1] = centre + left + right
        if mesh.side_x == "periodic":
            out[:, :, 0], out[:, :, -1] = out[:, :, -2], out[:, :, 1]
        return out

    first = fine.cx[:, :, 1:-1][:, :, ::2]
    second = fine.cx[:, :, 1:-1][:, :, 1::2]
    n = second.shape[2]
    series = np.zeros_like(conductor, dtype=float)
    total = first[:, :, :n] + second
    np.divide(first[:, :, :n] * second, total, out=series[:, :, 1 : n + 1], where=total > 0)
    if mesh.side_x == "periodic":
        series[:, :, 0] = series[:, :, n]
    cz = gather(fine.cz)
    cd = gather(np.where(fine.conductor, 0.0, fine.cd))
    # Where the coarse node below lies in the gate, the columns beside it still conduct.
    cd[:, 1:] += np.where(conductor[:, :-1] & free[:, 1:], cz[:, :-1], 0.0)
    cz[:, :-1] *= free[:, :-1] & free[:, 1:]
    cd = np.where(conductor, _PINNED, cd)
    south, north, dy = dual_widths(coarse_mesh.y, coarse_mesh.side_y, mesh.period[1])
    return replace(
        fine,
        mesh=coarse_mesh,
        cx=series,
        cy=gather(fine.cy) * free,
        cz=cz,
        cd=cd,
        kind=np.concatenate([[0], fine.kind[1:-1][::2], [0]]),
        north=link_factors(north, dy),
        south=link_factors(south, dy),
        dy=np.concatenate([[0.0], dy, [0.0]]),
        conductor=conductor,
    )
