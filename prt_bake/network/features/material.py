"""The material around points of the view ray, where it varies.

A scene states where one medium borders on another, and which spots of a boundary are rough. A network that does not see
this has to learn it point by point. Channels of it (`prt_bake.trainer.material`) are stored at the nodes of a coarse
grid. The network sees them at x and as means along the view ray, also blurred, since light that leaves at x was
scattered in its surroundings. It also sees their means, without blur, along equal parts of the ray's samples.
"""

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from formats.errors import ModelError
from prt_bake.network.features.lzma_bytes import packed_bytes, unpacked_bytes
from prt_bake.network.settings import MATERIAL_BLURS, MOST_CHANNELS

STEPS = 31
"""Steps between the lowest and the highest value of a channel."""
MOST_PER_SIDE, MOST_NODES = 128, 1 << 20
_SCALE = 2.0
"""Scale of the channels among other features, each of which has a mean square of ½."""
_LEAST_WEIGHT = 1e-6


class Material(NamedTuple):
    """Channels of the material at nodes 1/per_side box sides apart.

    rows uint8 [K,C], 0 to STEPS, are those of the nodes near which view rays pass, in the order of
    `feature_grid.kept_places`. A channel has no unit: networks see it with mean 0, and with a fixed variance if
    that is a step or more.
    """

    per_side: int
    rows: NDArray[np.uint8]

    def as_json(self) -> dict[str, int]:
        """All values except the rows, and their shape, as plain JSON."""
        return {"per_side": self.per_side, "nodes": self.rows.shape[0], "channels": self.rows.shape[1]}

    def packed(self) -> Tensor:
        """The rows, compressed: uint8 [bytes]."""
        return packed_bytes(self.rows.tobytes())

    @staticmethod
    def unpacked(values: dict[str, Any], packed: Tensor) -> "Material":
        """The inverse of `as_json` and `packed`; raises ModelError on values that they cannot have written."""
        limits = {"per_side": MOST_PER_SIDE, "nodes": MOST_NODES, "channels": MOST_CHANNELS}
        for name, most in limits.items():
            if type(values[name]) is not int or not 1 <= values[name] <= most:
                raise ModelError(
                    f"interior: {name} of the material: expected 1 to {most}, found {values[name]!r}; "
                    "train the model again"
                )
        shape = values["nodes"], values["channels"]
        rows = np.frombuffer(unpacked_bytes(packed, shape[0] * shape[1], "material"), np.uint8).reshape(shape)
        if int(rows.max()) > STEPS:
            raise ModelError(
                f"interior: the material has steps up to {STEPS}, found {rows.max()}; train the model again"
            )
        return Material(values["per_side"], rows)


def material_grid(material: Material, kept: NDArray[np.bool_]) -> Tensor:
    """Channels at the nodes of a grid [X,Y,Z,blurs·C], with mean 0 before the blurs MATERIAL_BLURS.

    kept [X,Y,Z] marks the nodes of the rows; a blur is a mean over these. Raises ModelError if their number differs.
    """
    if int(kept.sum()) != len(material.rows):
        raise ModelError(
            f"interior: its material has {len(material.rows)} nodes, but view rays pass {int(kept.sum())}; "
            "train the model again"
        )
    rows = material.rows.astype(np.float32)
    rows = _SCALE * (rows - rows.mean(axis=0)) / np.maximum(rows.std(axis=0), 1.0)
    values = np.zeros((*kept.shape, 1 + rows.shape[1]), np.float32)
    values[kept, 0], values[kept, 1:] = 1.0, rows
    grids = []
    for blur in MATERIAL_BLURS:
        deviation = 3 * [blur * material.per_side] + [0.0]
        blurred = ndimage.gaussian_filter(values, deviation, mode="constant")
        grids.append(blurred[..., 1:] / np.maximum(blurred[..., :1], _LEAST_WEIGHT))
    return torch.from_numpy(np.concatenate(grids, axis=-1))
