"""Checks the queries of a network: shapes, finite positions, and directions of length 1."""

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from formats.arguments import numbers
from formats.errors import QueryError

UNIT_TOLERANCE = 1e-3
"""Largest deviation of a direction's length from 1."""
BOX_TOLERANCE = 0.01
"""Largest distance of a position from the object's box, in sides of the box."""


def queries(
    incident: ArrayLike | Tensor, positions: ArrayLike | Tensor, outgoing: ArrayLike | Tensor, device: torch.device
) -> tuple[Tensor, Tensor, Tensor]:
    """incident [D,3] or [N,D,3], positions [N,3] and outgoing [N,3] as float64 tensors.

    Raises QueryError for other shapes, for positions that are not finite, and for directions that are not unit vectors.
    """
    light, x, eye = (
        float64_tensor(vectors if isinstance(vectors, Tensor) else numbers(name, vectors), device)
        for name, vectors in (("incident", incident), ("positions", positions), ("outgoing", outgoing))
    )
    if x.ndim != 2 or x.shape != eye.shape or light.ndim not in (2, 3) or {x.shape[-1], light.shape[-1]} != {3}:
        shapes = ", ".join(str(list(each.shape)) for each in (light, x, eye))
        raise QueryError(f"incident [D,3] or [N,D,3], positions [N,3] and outgoing [N,3]: found shapes {shapes}")
    if light.ndim == 3 and len(light) != len(x):
        raise QueryError(f"incident: expected [D,3] or [{len(x)},D,3], found {list(light.shape)}")
    require_finite("positions", x)
    _require_unit("incident", light)
    _require_unit("outgoing", eye)
    return light, x, eye


def require_finite(name: str, vectors: Tensor) -> None:
    """Raise QueryError for numbers that are infinite or NaN; no cell of a grid contains them."""
    if not bool(vectors.isfinite().all()):
        found = int((~vectors.isfinite().all(dim=-1)).sum())
        raise QueryError(f"{name}: expected finite numbers, found {found} of {vectors[..., 0].numel()} that are not")


def refuse_outside(positions: Tensor, box_min: Tensor, box_side: float) -> None:
    """Raise QueryError for positions [N,3] outside the object's box, where Ŝ has no meaning."""
    outside = ((positions - box_min) / box_side - 0.5).abs().gt(0.5 + BOX_TOLERANCE).any(dim=-1)
    if bool(outside.any()):
        first, (low, high) = int(outside.int().argmax()), (box_min.tolist(), (box_min + box_side).tolist())
        raise QueryError(
            f"positions: expected points on the object, in its box from {low} to {high}, found {int(outside.sum())} of "
            f"{len(outside)} outside; the first, number {first}, is {positions[first].tolist()}"
        )


def _require_unit(name: str, directions: Tensor) -> None:
    lengths = torch.linalg.vector_norm(directions, dim=-1).flatten()
    off = (lengths - 1.0).abs()
    if off.numel() and not float(off.max()) <= UNIT_TOLERANCE:  # also NaN
        raise QueryError(f"{name}: expected unit vectors, found one of length {float(lengths[int(off.argmax())]):.6g}")


def float64_tensor(vectors: ArrayLike | Tensor, device: torch.device) -> Tensor:
    """The numbers in float64 on `device`."""
    if isinstance(vectors, Tensor):
        return vectors.detach().to(device, torch.float64)
    # A copy: torch does not support read-only arrays.
    return torch.from_numpy(np.array(vectors, dtype=np.float64)).to(device)
