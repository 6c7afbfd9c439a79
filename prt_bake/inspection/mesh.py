"""Description, faults and remarks of a mesh."""

from pathlib import Path
from typing import Any

from formats.mesh import check_mesh, open_edges, read_mesh, signed_volume, texture_remark
from prt_bake.geometry.shells import ambiguity


def describe(path: Path) -> dict[str, Any]:
    """Return sizes, bounds and topology; a closed mesh has no open edges and a volume."""
    mesh = read_mesh(path, drop_flat_faces=True)
    return {
        "vertices": len(mesh.positions),
        "faces": len(mesh.faces),
        "faces without area": mesh.dropped_faces,
        "vertices merged": 0 if mesh.source_vertex is None else len(mesh.source_vertex) - len(mesh.positions),
        "bounds": mesh.bounds.tolist(),
        "diagonal": mesh.diagonal,
        "open edges": open_edges(mesh),
        "volume": signed_volume(mesh),
        "texture coordinates": mesh.corner_uv is not None,
        "content hash": mesh.content_hash,
    }


def find_faults(path: Path) -> list[str]:
    """Return the faults of a mesh: those of `formats.mesh.check_mesh`, else shells that overlap."""
    if faults := check_mesh(path):
        return faults
    what, _volume = ambiguity(read_mesh(path))
    return [f"{path}: {what}"] if what else []


def find_remarks(path: str | Path) -> list[str]:
    """Return remarks on texture coordinates outside the image, and on flat shading."""
    mesh = read_mesh(path)
    remarks = [texture_remark(mesh)] if texture_remark(mesh) else []
    if mesh.flat_shaded:
        remarks.append(
            "it is flat shaded, one normal per face, so that reflections show its faces; export it with smooth "
            "normals, or use --normals vertex"
        )
    return [f"{path}: {remark}" for remark in remarks]
