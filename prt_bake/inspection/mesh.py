"""Description, faults and remarks of a mesh."""

from pathlib import Path
from typing import Any

from formats.mesh import Mesh, check_mesh, open_edges, read_mesh, signed_volume, texture_remark
from formats.scene.units import NO_UNIT
from prt_bake.geometry.shells import ambiguity
from prt_bake.inspection.exported import glb_extras

_USUAL_SIZE = 1.0
"""Metres. Larger glTF objects were probably not modelled in metres."""


def describe(path: Path) -> dict[str, Any]:
    """Return sizes, bounds and topology; a closed mesh has no open edges and a volume.

    Of an exported asset also what it states of itself, under "exported".
    """
    mesh, exported = read_mesh(path, drop_flat_faces=True), glb_extras(path)
    return {
        "vertices": len(mesh.positions),
        "faces": len(mesh.faces),
        "faces without area": mesh.dropped_faces,
        "vertices merged": 0 if mesh.source_vertex is None else len(mesh.source_vertex) - len(mesh.positions),
        "unit": "m" if _is_gltf(path) else NO_UNIT,
        "bounds": mesh.bounds.tolist(),
        "diagonal": mesh.diagonal,
        "open edges": open_edges(mesh),
        "volume": signed_volume(mesh),
        "texture coordinates": mesh.corner_uv is not None,
        "content hash": mesh.content_hash,
        **({} if exported is None else {"exported": exported}),
    }


def find_faults(path: Path) -> list[str]:
    """Return the faults of a mesh: those of `formats.mesh.check_mesh`, else shells that overlap."""
    if faults := check_mesh(path):
        return faults
    what, _volume = ambiguity(read_mesh(path))
    return [f"{path}: {what}"] if what else []


def find_remarks(path: str | Path) -> list[str]:
    """Return remarks on texture coordinates outside the image, large glTF objects, and flat shading."""
    mesh = read_mesh(path)
    remarks = [texture_remark(mesh)] if texture_remark(mesh) else []
    if _is_gltf(path) and _longest_side(mesh) > _USUAL_SIZE:
        remarks.append(
            f"it is {_longest_side(mesh):.4g} m long, since glTF is in metres; jade, wax or marble of that size looks "
            "opaque; `prtbake init` with --size, such as --size 10cm, makes it as small as it is meant to be"
        )
    if mesh.flat_shaded:
        remarks.append(
            "it is flat shaded, one normal per face, so that reflections show its faces; export it with smooth "
            "normals, or use --normals vertex"
        )
    return [f"{path}: {remark}" for remark in remarks]


def needs_a_size(path: Path) -> bool:
    """Return whether a user should say how long the object is: the format has no unit, or it is very large."""
    return not _is_gltf(path) or _longest_side(read_mesh(path)) > _USUAL_SIZE


def _is_gltf(path: str | Path) -> bool:
    return Path(path).suffix.lower() in (".glb", ".gltf")


def _longest_side(mesh: Mesh) -> float:
    return float((mesh.bounds[1] - mesh.bounds[0]).max())
