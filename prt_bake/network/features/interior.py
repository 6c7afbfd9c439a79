"""The inside of an object as view rays meet it, small enough to be stored with the network.

Where view rays are followed through interfaces, the meshes of the bodies inside are part of it (`inner_bodies`).

Coarse grids hold signed distances to the boundaries of the object and of bodies inside it. With them are stored the
mean attenuation of each medium and the index of refraction. Lengths are in box sides, positions relative to the box's
corner.
"""

import hashlib
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from formats.errors import ModelError
from prt_bake.network.features.inner_bodies import InnerBody, packed_bodies, unpacked_bodies
from prt_bake.network.features.lzma_bytes import packed_bytes, unpacked_bytes
from prt_bake.network.features.material import MOST_NODES, Material

LEVELS = 15
REACH = 3.0
"""Distances are clipped to ±REACH spacings of the grid and stored in steps of REACH / LEVELS spacings."""
MAX_NODES = 1 << 22
_OF_OBJECT = 0.4
"""Occupancy where an object with bodies inside is perfectly clear; 1 where it is opaque."""
_LAYER = 0.1
"""Thickness, in box sides, of the layer of a medium that has its opacity."""
MAX_EXTENT = 5.0
"""Most box sides that the grid covers along an axis; it reaches little beyond the box. Also the largest eta."""


@dataclass(frozen=True)
class Interior:
    """The inside of an object; raises ModelError on inconsistent values.

    Attributes:
        levels: int8 [B,X,Y,Z], signed distance to the boundary of each body times LEVELS / (REACH · spacing), positive
            inside, clipped to ±LEVELS. The first body is the object; a body comes after the one that contains it.
        corner: position of levels[:,0,0,0].
        spacing: distance of the grid's nodes.
        attenuation: that of each body's medium, per box side, without light that is scattered forward.
        eta: index of refraction inside relative to outside.
        inner: meshes of the bodies after the first, where view rays are followed through them; else empty.
        material: what varies of the material; None if nothing does, or if the network does not see it.
    """

    levels: NDArray[np.int8]
    corner: tuple[float, float, float]
    spacing: float
    attenuation: tuple[float, ...]
    eta: float
    inner: tuple[InnerBody, ...] = ()
    material: Material | None = None

    def __post_init__(self) -> None:
        levels = np.ascontiguousarray(self.levels, np.int8)
        object.__setattr__(self, "levels", levels)
        grid, lengths = levels.shape, np.array([*self.corner, self.spacing, self.eta])
        if len(grid) != 4 or grid[0] < 1 or min(grid[1:]) < 2 or levels.size > MAX_NODES or _out_of_range(levels):
            raise ModelError(
                f"interior: levels must be [B,X,Y,Z] with 2 or more nodes per axis, at most {MAX_NODES} in all, and "
                f"values from -{LEVELS} to {LEVELS}; found shape {grid}"
            )
        if lengths.shape != (5,) or not np.isfinite(lengths).all() or min(lengths[3:]) <= 0:
            raise ModelError(
                "interior: corner must be three finite numbers, spacing and eta finite and positive; "
                f"found {lengths.tolist()}"
            )
        each = np.array(self.attenuation, np.float64)
        if each.shape != grid[:1] or not np.isfinite(each).all() or min(each) < 0:
            raise ModelError(
                f"interior: attenuation must be finite and not negative, one for each of {grid[0]} bodies; "
                f"found {list(self.attenuation)}"
            )

        if self.material is not None:
            extent = self.spacing * (np.array(grid[1:], np.float64) - 1.0)
            nodes = np.prod(extent * self.material.per_side + 2.0)
            if nodes > MOST_NODES:
                raise ModelError(
                    f"interior: a material of {self.material.per_side} nodes per box side has about {nodes:.3g} nodes; "
                    f"expected at most {MOST_NODES}; train the model again"
                )
        if self.inner and len(self.inner) != grid[0] - 1:
            raise ModelError(f"interior: {grid[0]} bodies need {grid[0] - 1} meshes inside, found {len(self.inner)}")

    @property
    def content_hash(self) -> str:
        """SHA-256 of all values, 64 hexadecimal digits."""
        meshes = b"".join(body.places.tobytes() + body.faces.tobytes() for body in self.inner)
        material = b"" if self.material is None else self.material.rows.tobytes()
        return hashlib.sha256(repr(self.as_json()).encode() + self.levels.tobytes() + meshes + material).hexdigest()

    @property
    def channels(self) -> int:
        """Channels of the material."""
        return 0 if self.material is None else self.material.rows.shape[1]

    def occupancy(self, with_bodies: bool = False) -> Tensor:
        """The share of the object [X,Y,Z] in the surroundings of each node, in [0, 1], float32.

        with_bodies: if there are bodies inside, a mean of this share and of the opacity of what fills it.
        """
        shares = torch.from_numpy(self.levels.astype(np.float32) * (REACH / LEVELS) + 0.5).clamp_(0.0, 1.0)
        if not with_bodies or len(shares) == 1:
            return shares[0]
        opacity = torch.zeros_like(shares[0])
        for attenuation, share in zip(self.attenuation, shares, strict=True):
            opacity.lerp_(torch.full_like(opacity, -math.expm1(-_LAYER * attenuation)), share)
        return _OF_OBJECT * shares[0] + (1.0 - _OF_OBJECT) * opacity

    def as_json(self) -> dict[str, Any]:
        """All values except the levels, the meshes and the rows of the material, as plain JSON."""
        return {
            "places": list(self.levels.shape),
            "corner": list(self.corner),
            "spacing": self.spacing,
            "attenuation": list(self.attenuation),
            "eta": self.eta,
            **({"inner": [body.as_json() for body in self.inner]} if self.inner else {}),
            **({"material": self.material.as_json()} if self.material is not None else {}),
        }

    def packed(self) -> Tensor:
        """The levels, compressed: uint8 [bytes]."""
        return packed_bytes(self.levels.tobytes())

    def packed_inner(self) -> Tensor:
        """The meshes inside, compressed: uint8 [bytes]."""
        return packed_bodies(self.inner)

    @staticmethod
    def unpacked(
        values: dict[str, Any], packed: Tensor, inner: Tensor | None = None, material: Tensor | None = None
    ) -> "Interior":
        """The inverse of `as_json`, `packed`, `packed_inner` and `Material.packed`; raises ModelError on values that
        they cannot have written.
        """
        places = tuple(int(n) for n in values["places"])
        size = int(np.prod(places, dtype=np.float64)) if len(places) == 4 and min(places) > 0 else 0
        if not 8 <= size <= MAX_NODES:
            raise ModelError(
                f"interior: places must be four positive numbers with a product of at most {MAX_NODES}, found {places}"
            )
        x, y, z = (float(n) for n in values["corner"])
        levels = np.frombuffer(unpacked_bytes(packed, size, "grids"), np.int8).reshape(places)
        attenuation = tuple(float(n) for n in values["attenuation"])
        bodies = () if inner is None else unpacked_bodies(values["inner"], inner, places[0] - 1)
        if ("material" in values) != (material is not None):
            raise ModelError("interior: its material is missing in part; copy the file again, or train the model again")
        stored = None if material is None else Material.unpacked(values["material"], material)
        spacing, eta = float(values["spacing"]), float(values["eta"])
        interior = Interior(levels, (x, y, z), spacing, attenuation, eta, bodies, stored)
        extent = interior.spacing * max(places[1:])
        if max(abs(x), abs(y), abs(z), extent, interior.eta) > MAX_EXTENT:
            raise ModelError(
                f"interior: corner and extent, in box sides, and eta must be at most {MAX_EXTENT:g}; found corner "
                f"{[x, y, z]}, extent {extent:g}, eta {interior.eta:g}; train the model again"
            )
        return interior


def _out_of_range(levels: NDArray[np.int8]) -> bool:
    return int(levels.min()) < -LEVELS or int(levels.max()) > LEVELS
