"""Assets as binary glTF: the engine form as custom attributes `_PRT_r_k` of the vertices."""

import os
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.asset import Asset
from formats.errors import QueryError, refuse_path
from formats.scene.units import millimetres
from formats.version import program_version
from prt_bake.export.attributes import Exported, prt_attributes, vertex_colours
from prt_bake.export.engine_errors import FormError, degrees_for, form_error
from prt_bake.export.engine_form import DEFAULT_DEGREE, EngineForm, engine_form
from prt_bake.export.extras import StatedLight, extras, texel_coordinates
from prt_bake.export.glb import Buffer, write_glb
from prt_bake.export.quantization import (
    Quantized,
    dequantized,
    in_halves,
    quantized,
    warn_of_bright_vertices,
)
from prt_bake.lights.environment import project, read_environment
from prt_bake.shading.vertices import light_coefficients
from prt_bake.shipped.examples import example

Array = NDArray[np.float64]

SKY = "sky.hdr"
_TURN_Z_UP = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]
"""Quaternion from z up to y up, as in glTF."""


def export_gltf(
    asset: Asset,
    path: str | os.PathLike[str],
    degree: int | None = None,
    error: float | None = None,
    quantize: Literal["int8"] | None = None,
    light: ArrayLike | None = None,
    light_name: str = "",
    onto: str | os.PathLike[str] | None = None,
) -> FormError:
    """Write an asset as a binary glTF file (`.glb`), in harmonics of the view; docs/reference/gltf.md has its layout.

    Args:
        asset: the baked asset.
        path: the file to write.
        degree: of the harmonics of the view, 0 to 8; 3 by default.
        error: chooses the least degree whose coefficients are within this relative RMSE, in place of `degree`.
        quantize: "int8" stores 8 bits for each number, a third of the size; Blender does not import them. An
            InputWarning says if a few bright vertices take these bits from the others.
        light: [K,3], coefficients of a light to fold in; None keeps every light.
        light_name: stated in the file.
        onto: the `.glb` file that was baked. It is written to `path` as it is, with the attributes added to its meshes.

    Returns the error of the file compared with the asset.

    Raises QueryError for an argument that is not valid, an error that no degree reaches, and an asset without baked
    vertices; MeshError if the vertices of `onto` are not on the baked mesh, or its meshes are compressed, have a skin,
    morph targets or instances, or have parts in other files; StorageError if the file cannot be written.

    >>> import prt_bake as prt
    >>> error = prt.export_gltf(prt.read_asset("spot.h5"), "spot.glb")
    """
    refuse_path("asset", asset, "prt.read_asset")
    shown = None if light is None else StatedLight(light_name, light_coefficients(asset, light))
    exported = prepare_export(asset, degree, error, quantize, shown)
    write_gltf(asset, path, exported, onto)
    return exported.error


def prepare_export(
    asset: Asset,
    degree: int | None,
    error: float | None,
    quantize: str | None,
    light: StatedLight | None,
    halves: bool = False,
) -> Exported:
    """Compute what `write_gltf` writes and, with `halves`, `write_textures`.

    light: folded into the form, and that of the vertex colours. None keeps every light; the colours are then those
    under the shipped sky.
    """
    if degree is not None and error is not None:
        raise QueryError("degree and error: error chooses the degree; give one of them")
    if quantize not in (None, "int8"):
        raise QueryError(f"quantize: expected 'int8' or None, found {quantize!r}")
    into = None if light is None else light.coefficients
    light = light or _default_light(asset)
    degrees = [DEFAULT_DEGREE if degree is None else degree] if error is None else degrees_for(asset, error, into)
    for chosen in degrees:
        form, codes = _stored(asset, chosen, into, quantize, halves)
        measured = form_error(asset, form, light.coefficients, into)
        if error is None or measured.coefficients <= error:
            break
    else:
        raise QueryError(
            f"error: rounded numbers leave {measured.coefficients:.3g} at degree {degrees[-1]}, expected {error:g} or "
            "less; give a larger error, or omit quantize"
        )
    colours, scale = vertex_colours(asset, light.coefficients)
    entries = extras(asset, form, measured, light, scale)
    if codes is not None:
        entries |= {"quantize": "int8", "scales": codes.scales.astype(float).tolist()}
    return Exported(form, codes, measured, entries, colours)


def _stored(
    asset: Asset, degree: int, into: Array | None, quantize: str | None, halves: bool
) -> tuple[EngineForm, Quantized | None]:
    """The form as its numbers are stored, and its codes with `quantize`."""
    form = engine_form(asset, degree, into)
    codes = quantized(form) if quantize else None
    if codes is not None:
        exact, form = form, dequantized(form, codes)
        warn_of_bright_vertices(exact, form)
    return in_halves(form) if halves else form, codes


def write_gltf(
    asset: Asset, path: str | os.PathLike[str], exported: Exported, onto: str | os.PathLike[str] | None = None
) -> None:
    """Write a prepared export, alone or onto a file of the user."""
    if onto is not None:
        from prt_bake.export.onto import write_onto  # here, since pydantic takes long to load

        write_onto(asset, onto, path, exported)
        return
    buffer = Buffer()
    document = mesh_document(asset, buffer, texel_coordinates(len(asset.valid)), exported.colours)
    written = document["meshes"][0]
    written["primitives"][0]["attributes"] |= prt_attributes(buffer, exported)
    written["extras"] = {"prtbake": exported.extras}
    write_glb(path, document, buffer)


def mesh_document(
    asset: Asset, buffer: Buffer, texel: NDArray[np.float32], colours: NDArray[np.float32]
) -> dict[str, Any]:
    """The JSON of a file with the mesh of an asset, whose numbers are added to `buffer`: texel [V,2] as TEXCOORD_1,
    colours [V,3] as COLOR_0.
    """
    mesh = asset.mesh
    origin = (mesh.positions.min(axis=0) + mesh.positions.max(axis=0)) / 2.0
    uv = texel if mesh.uv is None else (mesh.uv * [1.0, -1.0] + [0.0, 1.0]).astype(np.float32)
    attributes = {
        "POSITION": buffer.add_vertices((mesh.positions - origin).astype(np.float32), bounds=True),
        "NORMAL": buffer.add_vertices(mesh.normals.astype(np.float32)),
        "TEXCOORD_0": buffer.add_vertices(uv),
        "TEXCOORD_1": buffer.add_vertices(texel),
        "COLOR_0": buffer.add_vertices(colours),
    }
    primitive = {
        "attributes": attributes,
        "indices": buffer.add_indices(mesh.faces, len(mesh.positions)),
        "material": 0,
    }
    return {
        "asset": {"version": "2.0", "generator": f"prtbake {program_version()}"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [_node(asset, origin)],
        "materials": [{"name": "prtbake", "pbrMetallicRoughness": {}, "extensions": {"KHR_materials_unlit": {}}}],
        "meshes": [{"name": "prtbake", "primitives": [primitive]}],
    }


def _default_light(asset: Asset) -> StatedLight:
    """The shipped sky, upright for the asset; for an asset of one light, that light."""
    if asset.quantity == "radiance":
        return StatedLight("the light of the asset", np.ones((1, 3)))
    sky = project(read_environment(example(SKY)), asset.degree, asset.up)
    return StatedLight(f"{SKY} of prtbake", sky)


def _node(asset: Asset, origin: Array) -> dict[str, Any]:
    """The node of the mesh: object space in metres, y up. A unit of unknown length counts as a metre."""
    metres = (millimetres(asset.unit) or 1000.0) / 1000.0
    placed = origin if asset.up == "y" else origin[[0, 2, 1]] * [1.0, 1.0, -1.0]
    node: dict[str, Any] = {"name": "prtbake", "mesh": 0, "translation": (metres * placed).tolist()}
    if asset.up == "z":
        node["rotation"] = _TURN_Z_UP
    if metres != 1.0:
        node["scale"] = [metres] * 3
    return node
