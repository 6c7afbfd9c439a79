"""What a ray of view meets inside an object, small enough to travel with its network.

Coarse grids of signed distances to the boundaries say where the object is and what lies inside it; beside them stand
how fast each medium attenuates on average, and how the interface bends the ray. Lengths are in sides of the object's
box, from its corner.
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
"""Distances are told as far as this, in spacings of the grid, in steps of REACH / LEVELS of one."""
MAX_NODES = 1 << 22
_LZMA = ({"id": lzma.FILTER_LZMA2, "preset": 9 | lzma.PRESET_EXTREME},)


@dataclass(frozen=True)
class Interior:
    """The inside of an object as a ray of view meets it; raises ModelError on what cannot be one.

    Attributes:
        levels: int8 [B,X,Y,Z], signed distance to the boundary of each body times LEVELS / (REACH · spacing), positive
            inside, clipped to ±LEVELS. The first is the object; what lies in another comes after it.
        corner: where levels[:,0,0,0] lies.
        spacing: of the grid.
        attenuation: of what fills each body, per box side, light that is scattered on ahead not counted.
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
        if len(grid) != 4 or grid[0] < 1 or min(grid[1:]) < 2 or levels.size > MAX_NODES or _beyond(levels):
            raise ModelError(
                f"interior: levels must be [B,X,Y,Z], 2 or more each way, {MAX_NODES} in all at most, from -{LEVELS} "
                f"to {LEVELS}; found {grid}"
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
        """SHA-256 of all of it, 64 hexadecimal digits."""
        return hashlib.sha256(repr(self.as_json()).encode() + self.levels.tobytes()).hexdigest()

    def as_json(self) -> dict[str, Any]:
        """Everything but the levels, as plain values."""
        return {
            "places": list(self.levels.shape),
            "corner": list(self.corner),
            "spacing": self.spacing,
            "attenuation": list(self.attenuation),
            "eta": self.eta,
        }

    def packed(self) -> Tensor:
        """The levels, compressed: uint8 [bytes]."""
        content = lzma.compress(self.levels.tobytes(), lzma.FORMAT_RAW, filters=_LZMA)
        return torch.from_numpy(np.frombuffer(content, np.uint8).copy())

    @staticmethod
    def unpacked(values: dict[str, Any], packed: Tensor) -> "Interior":
        """The reverse of `as_json` and `packed`; raises ModelError where they are not what those gave."""
        places = tuple(int(n) for n in values["places"])
        size = int(np.prod(places, dtype=np.float64)) if len(places) == 4 and min(places) > 0 else 0
        if not 8 <= size <= MAX_NODES:
            raise ModelError(f"interior: places {places} where four numbers are expected, {MAX_NODES} in all at most")
        try:
            reader = lzma.LZMADecompressor(lzma.FORMAT_RAW, filters=_LZMA)
            content = reader.decompress(packed.to(torch.uint8).numpy().tobytes(), max_length=size + 1)
        except lzma.LZMAError as fault:
            raise ModelError(f"interior: its grid cannot be unpacked ({fault}); write the model anew") from None
        if len(content) != size:
            raise ModelError(f"interior: its grid holds {len(content)} places, expected {size}; write the model anew")
        x, y, z = (float(n) for n in values["corner"])
        levels = np.frombuffer(content, np.int8).reshape(places)
        attenuation = tuple(float(n) for n in values["attenuation"])
        return Interior(levels, (x, y, z), float(values["spacing"]), attenuation, float(values["eta"]))


def _beyond(levels: NDArray[np.int8]) -> bool:
    return int(levels.min()) < -LEVELS or int(levels.max()) > LEVELS
