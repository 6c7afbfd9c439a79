"""Adds the attributes of the engine form to a `.glb` file of the user: `prtbake export ASSET --onto USER.glb`.

The file keeps its materials, textures, nodes, animations and extras. Each of its vertices gets the coefficients of the
baked vertex at the same place, where object space is the scene of the file at rest, as `read_mesh` reads it.
"""

import copy
import json
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from formats.asset import Asset
from formats.atomic import existing
from formats.errors import MeshError
from formats.mesh.gltf.container import GltfFile, open_gltf
from prt_bake.export.attributes import Exported, prt_attributes
from prt_bake.export.baked_nodes import BakedNode, baked_nodes
from prt_bake.export.extras import selftest, texel_coordinates
from prt_bake.export.glb import Buffer, write_glb

Record = dict[str, Any]


def write_onto(asset: Asset, user: str | os.PathLike[str], path: str | os.PathLike[str], exported: Exported) -> None:
    """Write the file `user` with the vertex attributes of a prepared export to `path`.

    Each mesh of the baked object gets the attributes `_PRT_…`, the texel of the baked vertex in the next set of texture
    coordinates, COLOR_0 if it has neither colours nor a material, and the key "prtbake" of its extras. Other objects
    are left as they are, with an InputWarning. A mesh that several nodes show is copied for each of them.

    Raises:
        MeshError: vertices are not on the baked mesh, or the file has compressed geometry, parts in other files, or a
            baked mesh with a skin, morph targets or instances.
        StorageError: the file is missing or cannot be written.
    """
    if Path(user).suffix.lower() != ".glb":
        raise MeshError(f"{user}: expected a .glb file to export onto; export the object as .glb, and bake that file")
    file = open_gltf(existing(user))
    nodes = baked_nodes(file, asset.mesh)
    document, buffer = _opened(file)
    meshes = _own_meshes(document, nodes)
    for mesh in meshes:
        _refuse_earlier_export(mesh, user)
    shown = [mesh["primitives"][number] for mesh, node in zip(meshes, nodes, strict=True) for number in node.shown]
    texel = _texel_set(shown)
    columns = {"COLOR_0": exported.colours, f"TEXCOORD_{texel}": texel_coordinates(len(asset.valid))}
    for mesh, node in zip(meshes, nodes, strict=True):
        for accessor, vertices in node.vertices.items():
            primitives = [mesh["primitives"][number] for number in node.shown]
            alike = [one for one in primitives if one["attributes"]["POSITION"] == accessor]
            added = prt_attributes(buffer, exported, vertices)
            for name, values in columns.items():
                if any(name not in one["attributes"] for one in alike):
                    added[name] = buffer.add_vertices(values[vertices])
            if any("material" in one for one in alike):
                added.pop("COLOR_0", None)  # it would be multiplied into the base colour
            # Sets of texture coordinates are numbered without gaps.
            added |= {f"TEXCOORD_{number}": added[f"TEXCOORD_{texel}"] for number in range(texel)}
            for one in alike:
                one["attributes"].update(added | one["attributes"])
        used = np.unique(np.concatenate(list(node.vertices.values())))
        entries = exported.extras | {
            "texel_attribute": f"TEXCOORD_{texel}",
            "local_to_object": node.to_object.ravel().tolist(),
            "selftest": selftest(asset, exported.form, used),
        }
        mesh.setdefault("extras", {})["prtbake"] = entries
    write_glb(path, document, buffer)


def _opened(file: GltfFile) -> tuple[Record, Buffer]:
    """Return the JSON and the buffer of a file.

    Raises MeshError if the file is no GLB, has parts in other files, or numbers that JSON cannot hold.
    """
    if file.text is None:
        raise MeshError(f"{file.path}: expected binary glTF, found glTF as text; export it as .glb")

    def finite(number: str) -> float:
        value = float(number)
        if not math.isfinite(value):
            remedy = "correct it or remove it in the program that wrote the file"
            raise MeshError(f"{file.path}: JSON: expected finite numbers, found {number}; {remedy}")
        return value

    document: Record = json.loads(file.text, parse_float=finite, parse_constant=finite)
    remedy = "export it as one .glb file"
    images = document.get("images")
    for index, image in enumerate(images if isinstance(images, list) else []):
        uri = str(image.get("uri", "data:")) if isinstance(image, dict) else "data:"
        if uri[:5].lower() != "data:":
            raise MeshError(f"{file.path}: images[{index}]: is in another file, {uri[:80]!r}; {remedy}")
    first, *others = file.records.buffers
    if others or first.uri is not None or file.binary is None:
        raise MeshError(f"{file.path}: buffers: expected the binary chunk alone, found others; {remedy}")
    return document, Buffer(bytes(file.binary[: first.byteLength]), document["accessors"], document["bufferViews"])


def _own_meshes(document: Record, nodes: Sequence[BakedNode]) -> list[Record]:
    """Return the mesh of each node, a copy if other nodes show it, too."""
    meshes = []
    for each in nodes:
        node = document["nodes"][each.node]
        if sum(other.get("mesh") == node["mesh"] for other in document["nodes"]) > 1:
            document["meshes"].append(copy.deepcopy(document["meshes"][node["mesh"]]))
            node["mesh"] = len(document["meshes"]) - 1
        meshes.append(document["meshes"][node["mesh"]])
    return meshes


def _refuse_earlier_export(mesh: Record, user: str | os.PathLike[str]) -> None:
    """Raise MeshError if a mesh has attributes of an earlier export, or extras that cannot take a key."""
    if any(name.startswith("_PRT_") for one in mesh["primitives"] for name in one["attributes"]):
        raise MeshError(
            f"{user}: has the attributes _PRT_… of an earlier export; export onto the file as it was before"
        )
    if not isinstance(mesh.get("extras", {}), dict):
        raise MeshError(f"{user}: meshes: expected extras with keys, found {mesh['extras']!r:.80}; export it without")


def _texel_set(primitives: Sequence[Record]) -> int:
    """Return the first set of texture coordinates, from 1 on, that no primitive has."""
    sets: list[int] = [sum(name.startswith("TEXCOORD_") for name in one["attributes"]) for one in primitives]
    return max(1, *sets)
