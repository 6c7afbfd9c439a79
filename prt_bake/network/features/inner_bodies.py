"""The meshes of the bodies inside an object, small enough to be stored with its network.

A view ray may be reflected many times between two interfaces, as in the wall of a glass. Faces that rounding has turned
then lead it elsewhere: in the drink with ice, positions of 16 bits misled one ray in fifteen, which caused half of the
squared error. Positions are therefore as fine as those of the rays' own mesh, if the bodies are small enough.
"""

from bisect import bisect_left
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from formats.errors import ModelError
from prt_bake.network.features.lzma_bytes import packed_bytes, unpacked_bytes

STEPS = 1 << 24
"""Steps of positions per box side, as fine as float32."""
_FEW_STEPS = 65535
"""Those of bodies too large for finer ones, and of models that do not state them."""
_HALVINGS = 8
"""From `STEPS` to `_FEW_STEPS`, whose positions take two bytes."""
MOST_BYTES = 65_536
"""Byte budget of the bodies of a model."""
_MAX_ETA = 5.0
_MAX_FACES = 1 << 18


class InnerBody(NamedTuple):
    """A closed mesh inside an object.

    Attributes:
        places: uint32 or uint16 [V,3], positions in box sides from the box's corner, times `steps`.
        faces: uint32 [F,3], counter-clockwise seen from outside.
        parent: number of the body that contains it, 0 for the object.
        eta: index of refraction inside, relative to the outside of the object.
        smooth: whether rays are bent by normals that are interpolated between the vertices.
        steps: per box side.
    """

    places: NDArray[Any]
    faces: NDArray[np.uint32]
    parent: int
    eta: float
    smooth: bool
    steps: int = STEPS

    @property
    def positions(self) -> NDArray[np.float64]:
        """Positions [V,3] in box sides from the box's corner."""
        return self.places / self.steps

    def as_json(self) -> dict[str, Any]:
        """All values except the arrays, and the arrays' lengths, as plain JSON."""
        lengths = {"vertices": len(self.places), "faces": len(self.faces)}
        return {**lengths, "parent": self.parent, "eta": self.eta, "smooth": self.smooth, "steps": self.steps}


class Shape(NamedTuple):
    """An `InnerBody` before rounding: positions [V,3] in box sides, and faces [F,3]."""

    positions: NDArray[np.float64]
    faces: NDArray[Any]
    parent: int
    eta: float
    smooth: bool


def fitting_bodies(shapes: list[Shape]) -> tuple[InnerBody, ...]:
    """The bodies, rounded to the finest steps with which they fit into MOST_BYTES.

    Vertices that a coarse step joins are one, and faces that lose their area are left out.
    """
    if not shapes:
        return ()

    def rounded(halvings: int) -> tuple[InnerBody, ...]:
        return tuple(_rounded(shape, halvings) for shape in shapes)

    return rounded(bisect_left(range(STEPS.bit_length()), True, key=lambda halvings: _fit(rounded(halvings))))


def _fit(bodies: tuple[InnerBody, ...]) -> bool:
    """Whether bodies are within the budget; no face takes less than a byte, so that large meshes are not compressed."""
    return sum(len(body.faces) for body in bodies) <= MOST_BYTES and len(packed_bodies(bodies)) <= MOST_BYTES


def _rounded(shape: Shape, halvings: int) -> InnerBody:
    """A body whose positions are rounded to STEPS, so often halved, per box side."""
    fine = halvings < _HALVINGS
    per_side, step = (STEPS, 1 << halvings) if fine else (_FEW_STEPS, 1 << halvings - _HALVINGS)
    steps = np.clip(np.rint(shape.positions * (per_side / step)) * step, 0, per_side)
    steps = steps.astype(np.uint32 if fine else np.uint16)
    places, index = np.unique(steps, axis=0, return_inverse=True)
    joined = index.reshape(-1)[np.asarray(shape.faces, np.int64)].astype(np.uint32)
    apart = (joined != np.roll(joined, 1, axis=1)).all(axis=1)
    return InnerBody(places, joined[apart], shape.parent, shape.eta, shape.smooth, per_side)


def packed_bodies(bodies: tuple[InnerBody, ...]) -> Tensor:
    """The arrays of the bodies, compressed: uint8 [bytes]."""
    return packed_bytes(b"".join(body.places.tobytes() + body.faces.tobytes() for body in bodies))


def unpacked_bodies(values: list[dict[str, Any]], packed: Tensor, count: int) -> tuple[InnerBody, ...]:
    """The inverse of `InnerBody.as_json` and `packed_bodies` for `count` bodies; raises ModelError on values that they
    cannot have written.
    """
    if len(values) != count:
        raise ModelError(f"interior: expected {count} meshes inside, found {len(values)}; train the model again")
    for number, value in enumerate(values):
        _check(value, number)
    steps = [value.get("steps", _FEW_STEPS) for value in values]
    kinds = [np.dtype(np.uint16 if count == _FEW_STEPS else np.uint32) for count in steps]
    sizes = [(3 * kind.itemsize * v["vertices"], 12 * v["faces"]) for v, kind in zip(values, kinds, strict=True)]
    content = unpacked_bytes(packed, sum(map(sum, sizes)), "meshes")
    bodies, at = [], 0
    for value, per_side, kind, (first, second) in zip(values, steps, kinds, sizes, strict=True):
        places = np.frombuffer(content, kind, first // kind.itemsize, at).reshape(-1, 3)
        faces = np.frombuffer(content, np.uint32, second // 4, at + first).reshape(-1, 3)
        if len(faces) and int(faces.max()) >= len(places):
            raise ModelError(f"interior: a face inside has vertex {int(faces.max())}, expected below {len(places)}")
        bodies.append(InnerBody(places, faces, value["parent"], float(value["eta"]), value["smooth"], per_side))
        at += first + second
    return tuple(bodies)


def _check(value: dict[str, Any], number: int) -> None:
    """Raise ModelError unless the values of an inner body, counted from 0, can be right."""
    valid = {
        "vertices": (type(value["vertices"]) is int and 0 <= value["vertices"] <= _MAX_FACES, f"0 to {_MAX_FACES}"),
        "faces": (type(value["faces"]) is int and 0 <= value["faces"] <= _MAX_FACES, f"0 to {_MAX_FACES}"),
        "parent": (type(value["parent"]) is int and 0 <= value["parent"] <= number, f"0 to {number}"),
        "eta": (0.0 < float(value["eta"]) <= _MAX_ETA, f"above 0, at most {_MAX_ETA:g}"),
        "smooth": (type(value["smooth"]) is bool, "true or false"),
        "steps": (value.get("steps", _FEW_STEPS) in (_FEW_STEPS, STEPS), f"{_FEW_STEPS} or {STEPS}"),
    }
    for name, (fits, expected) in valid.items():
        if not fits:
            raise ModelError(
                f"interior: {name} of mesh {number + 1} inside: expected {expected}, found {value.get(name)!r}; "
                "train the model again"
            )
