"""Tests for artefacts of spherical coordinates in a network: the seam at φ = 0 and the poles at ±z, in ωi and in ωo.

Jumps need no reference: Ŝ is continuous, so a network's change over a tiny angle is its own error. The seam is compared
with eleven other meridians and the poles with ten other axes, where the network also changes a little, by its slope.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prt_bake.mathematics import directions
from prt_bake.mathematics.noise_free import Sums
from prt_bake.trainer.report.evaluation import above

Array = NDArray[np.float64]

VISIBLE = 0.01
"""Jump over the rms of Ŝ that is about the least visible contrast."""
STANDS_OUT = 4.0
"""z beyond which the difference is significant; eight such tests give a false alarm 3 times in 10,000."""
_MERIDIANS = 12
_STEP = 1e-4
"""Half the width of the step across the seam, and the radius of the ring about a pole [radians]."""
_RING = 8
_MOST_HEIGHT = 0.9
"""Largest |cosθ| at which the seam is crossed, clear of the poles."""
_NEAR_SEAM, _NEAR_POLE = np.radians(10.0), np.cos(np.radians(15.0))


@dataclass(frozen=True)
class Jump:
    """The rms jumps at the seam or pole and elsewhere, over the rms of Ŝ; z of their difference."""

    there: float
    elsewhere: float
    z: float

    @property
    def visible(self) -> bool:
        """Whether the jump is significant and large enough to be visible."""
        return self.z > STANDS_OUT and self.there > VISIBLE

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return {**vars(self), "visible": self.visible}


def jumps(network: Any, positions: Array, normals: Array, seed: int) -> dict[str, Jump]:
    """The jumps at positions [N,3] with normals [N,3]: "seam of incident", "pole of outgoing" and so on."""
    results = {}
    for name, directions_near in (("seam", _across_meridians), ("pole", _around_axes)):
        sets = directions_near(len(positions), seed)
        for varied in ("incident", "outgoing"):
            results[f"{name} of {varied}"] = _jump(network, positions, normals, sets, varied, seed)
    return results


def _jump(network: Any, positions: Array, normals: Array, sets: Array, varied: str, seed: int) -> Jump:
    """The jump of `varied` over sets [M,N,S,3] of S close directions, N at each of M places; place 0 is tested."""
    places, count, near = sets.shape[:3]
    rows = np.broadcast_to(positions, (places, count, 3)).reshape(-1, 3)
    facing = np.broadcast_to(normals, (places, count, 3)).reshape(-1, 3)
    close = sets.reshape(-1, near, 3)
    other = directions.uniform(len(rows), seed + 1)
    if varied == "incident":
        answer = network.evaluate(close, rows, above(other, facing))
    else:
        # Views from below the surface are left out.
        visible = np.sum(close[:, 0] * facing, axis=1) > 0.05
        rows, close, other = rows[visible], close[visible], other[visible]
        flat = np.repeat(rows, near, axis=0), close.reshape(-1, 3)
        answer = network.evaluate(np.repeat(other, near, axis=0)[:, None], *flat)
    values = np.asarray(answer, np.float64).reshape(len(rows), near, 3)
    spread = values.var(axis=1, ddof=1).sum(axis=1)
    first = np.zeros(places * count, bool)
    first[:count] = True
    first = first if varied == "incident" else first[visible]
    return _compared(spread[first], spread[~first], float((values**2).sum(axis=2).mean()))


def _compared(there: Array, elsewhere: Array, square: float) -> Jump:
    unit = max(square, 1e-300)
    error = np.sqrt(there.var(ddof=1) / len(there) + elsewhere.var(ddof=1) / len(elsewhere))
    difference = float(there.mean() - elsewhere.mean())
    return Jump(
        # The variance of two values is half their squared difference.
        there=float(np.sqrt(2.0 * there.mean() / unit)),
        elsewhere=float(np.sqrt(2.0 * elsewhere.mean() / unit)),
        z=difference / float(error) if error > 0.0 else 0.0,
    )


def _across_meridians(count: int, seed: int) -> Array:
    """Pairs on both sides of φ = 0 and of 11 other meridians [12,N,2,3]."""
    height = _MOST_HEIGHT * directions.uniform(_MERIDIANS * count, seed)[:, 2].reshape(_MERIDIANS, count, 1)
    phi = 2.0 * np.pi * np.arange(_MERIDIANS)[:, None, None] / _MERIDIANS + _STEP * np.array([-1.0, 1.0])
    radius = np.sqrt(1.0 - height**2)
    parts = [radius * np.cos(phi), radius * np.sin(phi), np.broadcast_to(height, (_MERIDIANS, count, 2))]
    return np.stack(np.broadcast_arrays(*parts), axis=-1)


def _around_axes(count: int, seed: int) -> Array:
    """Rings about +z or −z and about 10 axes that are far from them [11,N,8,3]."""
    phi = 2.0 * np.pi * np.arange(_RING) / _RING
    ring = np.stack([_STEP * np.cos(phi), _STEP * np.sin(phi), np.full(_RING, np.sqrt(1.0 - _STEP**2))], axis=-1)
    pole = ring * np.where(np.arange(count) % 2, 1.0, -1.0)[:, None, None]
    turn = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    others = []
    for k in range(10):
        angle = 2.0 * np.pi * (k + 0.5) / 10.0
        about = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
        others.append(np.broadcast_to(ring @ turn.T @ about.T, (count, _RING, 3)))
    return np.stack([pole, *others])


def near_seam(rows: Array) -> NDArray[np.bool_]:
    """Whether directions [...,3] are within 10° of the half plane φ = 0."""
    return np.asarray(np.abs(np.arctan2(rows[..., 1], rows[..., 0])) < _NEAR_SEAM)


def near_pole(rows: Array) -> NDArray[np.bool_]:
    """Whether directions [...,3] are within 15° of ±z."""
    return np.asarray(np.abs(rows[..., 2]) > _NEAR_POLE)


def compared_with_elsewhere(parts: Sums, near: NDArray[np.bool_]) -> dict[str, Any]:
    """Relative RMSE of values [N,D] near a seam or pole and elsewhere, and z of the difference of their squares.

    Rows of `parts` [N,D] are independent; the difference's standard error is that of linearised ratios.
    """
    chosen = near.astype(np.float64)
    squares, influence = [], np.zeros(len(chosen))
    for part, sign in ((chosen, 1.0), (1.0 - chosen, -1.0)):
        error, value = (parts.error * part).sum(axis=1), (parts.value * part).sum(axis=1)
        total = max(float(value.sum()), 1e-300)
        squares.append(float(error.sum()) / total)
        influence += sign * (error - squares[-1] * value) / total
    deviation = float(np.sqrt((influence**2).sum()))
    z = (squares[0] - squares[1]) / deviation if deviation > 0.0 else 0.0
    rms = [float(np.sqrt(max(0.0, square))) for square in squares]
    return {"there": rms[0], "elsewhere": rms[1], "z": z, "values": int(near.sum()), "stands_out": z > STANDS_OUT}
