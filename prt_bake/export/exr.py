"""The engine form as a texture, for engines that take no vertex attributes of their own: X.exr, X.json, X.mesh.glb."""

import math
import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.asset import Asset
from formats.atomic import replacing
from formats.errors import QueryError, refuse_path
from formats.image.exr import write_exr_halves
from formats.json_report import write_report
from prt_bake.export.attributes import Exported
from prt_bake.export.engine_errors import FormError
from prt_bake.export.engine_form import EngineForm
from prt_bake.export.extras import StatedLight
from prt_bake.export.glb import Buffer, write_glb
from prt_bake.export.gltf import mesh_document, prepare_export
from prt_bake.shading.vertices import light_coefficients

LARGEST_SIDE = 16384
"""Texels of a side of a texture that GPUs of computers take."""
_OF_ATTRIBUTES = ("attributes", "texels", "quantize")
"""Entries of extras.prtbake that a texture has not."""


class Layout(NamedTuple):
    """Where a vertex is in the texture: a run of texels that never wraps, several vertices a row."""

    width: int
    height: int
    vertices_per_row: int
    texels_per_vertex: int


def export_exr(
    asset: Asset,
    path: str | os.PathLike[str],
    degree: int | None = None,
    error: float | None = None,
    light: ArrayLike | None = None,
    light_name: str = "",
) -> FormError:
    """Write an asset as a texture of half floats X.exr, its description X.json and its mesh X.mesh.glb.

    docs/reference/texture.md has the layout.

    Args:
        asset: the baked asset.
        path: the texture, X.exr; the other files are written beside it.
        degree: of the harmonics of the view, 0 to 8; 3 by default.
        error: chooses the least degree whose coefficients are within this relative RMSE, in place of `degree`.
        light: [K,3], coefficients of a light to fold in; None keeps every light.
        light_name: stated in X.json.

    Returns the error of the texture compared with the asset.

    Raises QueryError for an argument that is not valid, an error that no degree reaches, an asset without baked
    vertices, coefficients beyond half floats, and a texture of more than 16,384 texels a side; StorageError if a file
    cannot be written.

    >>> import prt_bake as prt
    >>> error = prt.export_exr(prt.read_asset("spot.h5"), "spot.exr")
    """
    refuse_path("asset", asset, "prt.read_asset")
    shown = None if light is None else StatedLight(light_name, light_coefficients(asset, light))
    exported = prepare_export(asset, degree, error, None, shown, halves=True)
    write_textures(asset, path, exported)
    return exported.error


def texture_files(path: str | os.PathLike[str]) -> tuple[Path, Path, Path]:
    """The files that `write_textures` writes: X.exr, X.json, X.mesh.glb."""
    texture = Path(path)
    return texture, texture.with_suffix(".json"), texture.with_suffix(".mesh.glb")


def write_textures(asset: Asset, path: str | os.PathLike[str], exported: Exported) -> None:
    """Write an export that was prepared with `halves`."""
    texture, description, mesh = texture_files(path)
    layout = layout_of(exported.form)
    entries = {name: entry for name, entry in exported.extras.items() if name not in _OF_ATTRIBUTES}
    entries["texture"] = layout._asdict()
    buffer = Buffer()
    document = mesh_document(asset, buffer, first_texels(len(asset.valid), layout), exported.colours)
    with replacing(texture) as part:
        write_exr_halves(part, texels_of(exported.form, layout))
    write_glb(mesh, document, buffer)
    write_report(entries, description)


def layout_of(form: EngineForm) -> Layout:
    """The most square layout. Raises QueryError if a side is longer than GPUs take."""
    vertices, run = form.coefficients.shape[0], math.prod(form.coefficients.shape[1:3])
    per_row = min(vertices, max(1, round(math.sqrt(vertices / run))))
    layout = Layout(per_row * run, -(-vertices // per_row), per_row, run)
    if max(layout[:2]) > LARGEST_SIDE:
        raise QueryError(
            f"asset: {vertices:,} vertices of {run} texels need a texture of {layout.width:,} × {layout.height:,} "
            f"texels, GPUs take {LARGEST_SIDE:,} a side; lower --degree, fold a light in with --light, or bake a "
            "coarser mesh"
        )
    return layout


def texels_of(form: EngineForm, layout: Layout) -> NDArray[np.float16]:
    """The texture [H,W,3], row 0 at the top; 0 after the last vertex."""
    vertices = len(form.coefficients)
    texels = np.zeros((layout.height * layout.vertices_per_row, layout.texels_per_vertex, 3), np.float16)
    texels[:vertices] = form.coefficients.reshape(vertices, -1, 3)
    return texels.reshape(layout.height, layout.width, 3)


def first_texels(vertices: int, layout: Layout) -> NDArray[np.float32]:
    """Centres of the first texels of the vertices [V,2], from 0 to 1 across the texture, v downwards."""
    row, place = np.divmod(np.arange(vertices), layout.vertices_per_row)
    column = place * layout.texels_per_vertex
    return np.stack([(column + 0.5) / layout.width, (row + 0.5) / layout.height], axis=1).astype(np.float32)
