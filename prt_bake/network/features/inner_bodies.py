"""The meshes of the bodies inside an object, small enough to be stored with its network."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from formats.errors import ModelError
from prt_bake.network.features.lzma_bytes import packed_bytes, unpacked_bytes

STEPS = 65535
"""Steps of positions per box side."""
MOST_BYTES = 65_536
"""Byte budget of the bodies of a model."""
_MOST_FACES = 1 << 20


class InnerBody(NamedTuple):
    """A closed mesh inside an object.

    Attributes:
        places: uint16 [V,3], positions in box sides from the box's corner, times STEPS.
        faces: uint32 [F,3], counter-clockwise seen from outside.
        eta: index of refraction inside, relative to the outside of the object.
    """

    places: NDArray[np.uint16]
    faces: NDArray[np.uint32]
    eta: float

    def as_json(self) -> dict[str, Any]:
        """All values except the arrays, as plain JSON."""
        return {"vertices": len(self.places), "faces": len(self.faces), "eta": self.eta}


def fitting_bodies(meshes: list[tuple[NDArray[np.float64], NDArray[Any], float]]) -> tuple[InnerBody, ...]:
    """The bodies of meshes (positions [V,3] in box sides, faces [F,3], eta), in steps as coarse as MOST_BYTES needs.

    Vertices that fall together in a coarse step are one, and faces without area between them are left out.
    """
    step = 1
    while True:
        bodies = tuple(_rounded(*mesh, step) for mesh in meshes)
        if not bodies or len(packed_bodies(bodies)) <= MOST_BYTES:
            return bodies
        step *= 2


def _rounded(positions: NDArray[np.float64], faces: NDArray[Any], eta: float, step: int) -> InnerBody:
    steps = np.clip(np.rint(positions * (STEPS / step)) * step, 0, STEPS).astype(np.uint16)
    places, index = np.unique(steps, axis=0, return_inverse=True)
    joined = index.reshape(-1)[np.asarray(faces, np.int64)].astype(np.uint32)
    apart = (joined != np.roll(joined, 1, axis=1)).all(axis=1)
    return InnerBody(places, joined[apart], eta)


def packed_bodies(bodies: tuple[InnerBody, ...]) -> Tensor:
    """The arrays of the bodies, compressed: uint8 [bytes]."""
    return packed_bytes(b"".join(body.places.tobytes() + body.faces.tobytes() for body in bodies))


def unpacked_bodies(values: list[dict[str, Any]], packed: Tensor) -> tuple[InnerBody, ...]:
    """The inverse of `InnerBody.as_json` and `packed_bodies`; raises ModelError on values that they cannot have
    written.
    """
    counts = [(int(value["vertices"]), int(value["faces"]), float(value["eta"])) for value in values]
    if any(min(v, f) < 0 or max(v, f) > _MOST_FACES or not 0.0 < eta < np.inf for v, f, eta in counts):
        raise ModelError(f"interior: bodies must have 0 to {_MOST_FACES} vertices and faces, found {values}")
    content = unpacked_bytes(packed, sum(6 * v + 12 * f for v, f, _eta in counts), "bodies")
    bodies, at = [], 0
    for v, f, eta in counts:
        places = np.frombuffer(content, np.uint16, 3 * v, at).reshape(v, 3)
        faces = np.frombuffer(content, np.uint32, 3 * f, at + 6 * v).reshape(f, 3)
        if f and int(faces.max()) >= v:
            raise ModelError(f"interior: a face of a body has vertex {int(faces.max())}, expected below {v}")
        bodies.append(InnerBody(places, faces, eta))
        at += 6 * v + 12 * f
    return tuple(bodies)
