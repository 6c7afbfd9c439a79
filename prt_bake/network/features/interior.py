"""The inside of an object as view rays meet it, small enough to be stored with the network.

Coarse grids hold signed distances to the boundaries of the object and of bodies inside it. With them are stored the
mean attenuation of each medium and the index of refraction. Lengths are in box sides, positions relative to the box's
corner.
"""

import hashlib
import lzma
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from formats.errors import ModelError

LEVELS = 15
REACH = 3.0
"""Distances are clipped to ±REACH spacings of the grid and stored in steps of REACH / LEVELS spacings."""
MAX_NODES = 1 << 22
MAX_EXTENT = 5.0
"""Most box sides that the grid covers along an axis; it reaches little beyond the box. Also the largest eta."""
_LZMA = ({"id": lzma.FILTER_LZMA2, "preset": 9 | lzma.PRESET_EXTREME},)


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
    """

    levels: NDArray[np.int8]
    corner: tuple[float, float, float]
    spacing: float
    attenuation: tuple[float, ...]
    eta: float

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

    @property
    def content_hash(self) -> str:
        """SHA-256 of all values, 64 hexadecimal digits."""
        return hashlib.sha256(repr(self.as_json()).encode() + self.levels.tobytes()).hexdigest()

    def occupancy(self) -> Tensor:
        """The share of the object [X,Y,Z] in the surroundings of each node, in [0, 1], float32."""
        return torch.from_numpy(self.levels[0].astype(np.float32) * (REACH / LEVELS) + 0.5).clamp_(0.0, 1.0)

    def as_json(self) -> dict[str, Any]:
        """All values except the levels, as plain JSON."""
        return {
            "places": list(self.levels.shape),
            "corner": list(self.corner),
            "spacing": self.spacing,
            "attenuation": list(self.attenuation),
            "eta": self.eta,
        }

    def packed(self) -> Tensor:
        """The levels, compressed by LZMA: uint8 [bytes]."""
        content = lzma.compress(self.levels.tobytes(), lzma.FORMAT_RAW, filters=_LZMA)
        return torch.from_numpy(np.frombuffer(content, np.uint8).copy())

    @staticmethod
    def unpacked(values: dict[str, Any], packed: Tensor) -> "Interior":
        """The inverse of `as_json` and `packed`; raises ModelError on values that they cannot have written."""
        places = tuple(int(n) for n in values["places"])
        size = int(np.prod(places, dtype=np.float64)) if len(places) == 4 and min(places) > 0 else 0
        if not 8 <= size <= MAX_NODES:
            raise ModelError(
                f"interior: places must be four positive numbers with a product of at most {MAX_NODES}, found {places}"
            )
        try:
            reader = lzma.LZMADecompressor(lzma.FORMAT_RAW, filters=_LZMA)
            content = reader.decompress(packed.to(torch.uint8).numpy().tobytes(), max_length=size + 1)
        except lzma.LZMAError as fault:
            raise ModelError(f"interior: its grid cannot be unpacked ({fault}); train the model again") from None
        if len(content) != size:
            raise ModelError(f"interior: its grid holds {len(content)} nodes, expected {size}; train the model again")
        x, y, z = (float(n) for n in values["corner"])
        levels = np.frombuffer(content, np.int8).reshape(places)
        attenuation = tuple(float(n) for n in values["attenuation"])
        interior = Interior(levels, (x, y, z), float(values["spacing"]), attenuation, float(values["eta"]))
        extent = interior.spacing * max(places[1:])
        if max(abs(x), abs(y), abs(z), extent, interior.eta) > MAX_EXTENT:
            raise ModelError(
                f"interior: corner and extent, in box sides, and eta must be at most {MAX_EXTENT:g}; found corner "
                f"{[x, y, z]}, extent {extent:g}, eta {interior.eta:g}; train the model again"
            )
        return interior


def _out_of_range(levels: NDArray[np.int8]) -> bool:
    return int(levels.min()) < -LEVELS or int(levels.max()) > LEVELS
