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
_MAX_ETA = 5.0
_MAX_FACES = 1 << 18


class InnerBody(NamedTuple):
    """A closed mesh inside an object.

    Attributes:
        places: uint16 [V,3], positions in box sides from the box's corner, times STEPS.
        faces: uint32 [F,3], counter-clockwise seen from outside.
        parent: number of the body that contains it, 0 for the object.
        eta: index of refraction inside, relative to the outside of the object.
        smooth: whether rays are bent by normals that are interpolated between the vertices.
    """

    places: NDArray[np.uint16]
    faces: NDArray[np.uint32]
    parent: int
    eta: float
    smooth: bool

    def as_json(self) -> dict[str, Any]:
        """All values except the arrays, and the arrays' lengths, as plain JSON."""
        lengths = {"vertices": len(self.places), "faces": len(self.faces)}
        return {**lengths, "parent": self.parent, "eta": self.eta, "smooth": self.smooth}


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
    step = 1
    while True:
        bodies = tuple(_rounded(shape, step) for shape in shapes)
        if not bodies or len(packed_bodies(bodies)) <= MOST_BYTES:
            return bodies
        step *= 2


def _rounded(shape: Shape, step: int) -> InnerBody:
    steps = np.clip(np.rint(shape.positions * (STEPS / step)) * step, 0, STEPS).astype(np.uint16)
    places, index = np.unique(steps, axis=0, return_inverse=True)
    joined = index.reshape(-1)[np.asarray(shape.faces, np.int64)].astype(np.uint32)
    apart = (joined != np.roll(joined, 1, axis=1)).all(axis=1)
    return InnerBody(places, joined[apart], shape.parent, shape.eta, shape.smooth)


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
    sizes = [(6 * value["vertices"], 12 * value["faces"]) for value in values]
    content = unpacked_bytes(packed, sum(map(sum, sizes)), "meshes")
    bodies, at = [], 0
    for value, (first, second) in zip(values, sizes, strict=True):
        places = np.frombuffer(content, np.uint16, first // 2, at).reshape(-1, 3)
        faces = np.frombuffer(content, np.uint32, second // 4, at + first).reshape(-1, 3)
        if len(faces) and int(faces.max()) >= len(places):
            raise ModelError(f"interior: a face inside has vertex {int(faces.max())}, expected below {len(places)}")
        bodies.append(InnerBody(places, faces, value["parent"], float(value["eta"]), value["smooth"]))
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
    }
    for name, (fits, expected) in valid.items():
        if not fits:
            raise ModelError(
                f"interior: {name} of mesh {number + 1} inside: expected {expected}, found {value[name]!r}; "
                "train the model again"
            )
