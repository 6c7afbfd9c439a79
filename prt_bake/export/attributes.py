"""What the vertices of an exported glTF file carry: the engine form, and colours for programs that do not know it."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from formats.asset import Asset
from prt_bake.export.engine_errors import FormError
from prt_bake.export.engine_form import EngineForm, blocks
from prt_bake.export.glb import Buffer
from prt_bake.export.quantization import Quantized

Array = NDArray[np.float64]

_BRIGHT = 99.0
"""Percentile of the vertex colours' radiance that is shown as white."""


class Exported(NamedTuple):
    """What is written: the engine form as a reader finds it, its codes if it is quantised, its error, its JSON.

    colours [V,3]: those of the vertices, under the light that `extras` states.
    """

    form: EngineForm
    codes: Quantized | None
    error: FormError
    extras: dict[str, Any]
    colours: NDArray[np.float32]


def prt_attributes(
    buffer: Buffer, exported: Exported, vertices: NDArray[np.integer] | slice = slice(None)
) -> dict[str, int]:
    """Add the attributes of the engine form to a buffer, of all or of some vertices, and return their accessors."""
    codes, form = exported.codes, exported.form
    stored: Any = form.coefficients if codes is None else codes.codes
    name = str(exported.extras["attributes"])
    return {
        name.format(r=r, k=k): buffer.add_vertices(stored[vertices, r, k], normalised=codes is not None)
        for r in range(stored.shape[1])
        for k in range(stored.shape[2])
    }


def vertex_colours(asset: Asset, light: Array) -> tuple[NDArray[np.float32], float]:
    """Colours [V,3] in [0,1], the mean over the view of the radiance under a light [K,3], and their scale."""
    weights = np.ones((1, 3)) if asset.quantity == "radiance" else light
    means = np.zeros((len(asset.valid), 3))
    for part, block in blocks(asset):
        means[part] = np.einsum("nkc,kc->nc", block.mean(axis=1, dtype=np.float64), weights)
    means = np.maximum(means, 0.0)
    brightest = float(np.percentile(means[asset.valid], _BRIGHT))
    scale = 1.0 / brightest if brightest > 0.0 else 1.0
    return np.minimum(scale * means, 1.0).astype(np.float32), scale
