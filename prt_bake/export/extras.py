"""What a reader of an exported asset must know, as JSON: `extras.prtbake` of a glTF mesh, X.json beside X.exr."""

import dataclasses
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from formats.asset import Asset
from formats.version import program_version
from prt_bake.export.engine_errors import FormError
from prt_bake.export.engine_form import EngineForm
from prt_bake.mathematics import sh

Array = NDArray[np.float64]

VERSION = "1.0"
LOCAL_TO_OBJECT = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
_TRANSFER = (
    "L(v,w,c) = max(0, sum over r,k of Y_r(w) A[v,r,k,c] b[k,c]); w: unit direction to the viewer and b: the light's "
    "radiance projected on Y, both in object space"
)
_RADIANCE = "L(v,w,c) = max(0, sum over r of Y_r(w) A[v,r,c]); w: unit direction to the viewer in object space"
_TEST_LIGHT = [[0.9, 0.7, 0.4], [0.5, -0.2, 0.3], [-0.3, 0.6, 0.1], [0.2, 0.1, -0.5]]
"""Coloured and without symmetry; further harmonics are smaller, of alternating sign."""
_TEST_DIRECTIONS = np.array(
    [[0.0, 0.0, 1.0], [0.36, 0.48, 0.8], [-0.48, 0.6, 0.64], [0.64, -0.6, 0.48], [-0.8, -0.6, 0.0], [0.6, 0.0, -0.8]]
)
"""In the frame of a vertex, z along the normal."""


class StatedLight(NamedTuple):
    """The light of the vertex colours. name: of its file, or in one word. coefficients [K,3]."""

    name: str
    coefficients: Array


def texels(vertices: int) -> tuple[int, int]:
    """Width and height of the texture coordinates that number the vertices; the width is a power of two."""
    width = 1 << max(0, math.ceil(math.log2(vertices) / 2.0))
    return width, -(-vertices // width)


def texel_coordinates(vertices: int) -> NDArray[np.float32]:
    """Centres of the texels of the vertices [V,2], v downwards as in glTF."""
    width, height = texels(vertices)
    number = np.arange(vertices)
    return np.stack([(number % width + 0.5) / width, (number // width + 0.5) / height], axis=1).astype(np.float32)


def extras(asset: Asset, form: EngineForm, error: FormError, light: StatedLight, colour_scale: float) -> dict[str, Any]:
    """The JSON of an exported asset; docs/reference/gltf.md describes it."""
    width, height = texels(len(asset.valid))
    highest = max(form.view_degree, form.light_degree)
    return {
        "version": VERSION,
        "generator": f"prtbake {program_version()}",
        "vertices": len(asset.valid),
        "quantity": form.quantity,
        "formula": _TRANSFER if form.quantity == "transfer" else _RADIANCE,
        "view_degree": form.view_degree,
        "light_degree": form.light_degree,
        "attributes": "_PRT_{r}_{k}" if form.quantity == "transfer" else "_PRT_{r}",
        "order": "l(l+1)+m",
        "sign": "no Condon-Shortley phase",
        "normalisation": "orthonormal",
        "local_to_object": LOCAL_TO_OBJECT,
        "up": asset.up,
        "unit": asset.unit,
        "texels": {"width": width, "height": height},
        "quantize": None,
        "eta": asset.eta,
        "roughness": asset.roughness,
        "check_directions": np.asarray(asset.check_directions, np.float64).tolist(),
        "check_values": sh.evaluate(asset.check_directions, highest).tolist(),
        "light": {
            "name": light.name,
            "coefficients": light.coefficients.tolist(),
            "colour_scale": colour_scale,
        },
        "error": dataclasses.asdict(error),
        "asset_error": str(asset.error),
        "left_out": _left_out(asset, form),
        "selftest": selftest(asset, form),
    }


def selftest(asset: Asset, form: EngineForm, among: NDArray[np.integer] | None = None) -> dict[str, Any]:
    """Radiance that a reader must find: six views of the first, the last and two other vertices, not clamped to 0.

    among: the vertices to choose from, ascending; None for all.
    """
    present = np.arange(len(asset.valid)) if among is None else among
    valid = present[asset.valid[present]] if asset.valid[present].any() else present
    chosen = valid[[0, len(valid) // 3, 2 * len(valid) // 3, -1]]
    vertices = chosen[np.arange(len(_TEST_DIRECTIONS)) % len(chosen)]
    normals, tangents = asset.mesh.normals[vertices], np.asarray(asset.tangents, np.float64)[vertices]
    x, y, z = _TEST_DIRECTIONS.T[:, :, None]
    outgoing = x * tangents + y * np.cross(normals, tangents) + z * normals
    outgoing /= np.linalg.norm(outgoing, axis=1, keepdims=True)
    further = [[0.1 * (-1) ** k, 0.05, -0.08 * (-1) ** k] for k in range(len(_TEST_LIGHT), sh.count(form.light_degree))]
    light = np.array((_TEST_LIGHT + further)[: sh.count(form.light_degree)])
    if form.quantity == "radiance":
        light = np.ones((1, 3))
    return {
        "light": light.tolist(),
        "vertex": vertices.tolist(),
        "outgoing": outgoing.tolist(),
        "radiance": form.radiance(vertices, outgoing, light).tolist(),
    }


def _left_out(asset: Asset, form: EngineForm) -> list[str]:
    """What the asset or its pictures have and the exported form has not."""
    missing = ["light reflected at the surface", "suns shaded apart"]
    if asset.lobes is not None:
        missing.append("lobes")
    unbaked = int((~asset.valid).sum())
    return [*missing, f"{unbaked} vertices that were not baked, which are black"] if unbaked else missing
