"""The faults of a mesh: open, inconsistent or overfull edges, unusable texture coordinates, lost precision."""

import os

import numpy as np
from numpy.typing import NDArray

from formats.errors import MeshError
from formats.mesh.edges import doubled_faces, edges_of, overlapping, remedy
from formats.mesh.record import Mesh, read_mesh, signed_volume
from formats.mesh.texture_coordinates import texture_fault


def check_mesh(path: str | os.PathLike[str]) -> list[str]:
    """Return every fault of a mesh file, a sentence each; an empty list means a valid closed surface."""
    faults = []
    try:
        mesh = read_mesh(path)
    except MeshError as fault:
        faults.append(str(fault))
        try:
            mesh = read_mesh(path, drop_flat_faces=True)
        except MeshError:
            return faults
    found = closedness_faults(mesh)
    faults += [f"{path}: {fault}" for fault in found]
    if not faults and signed_volume(mesh) < 0:
        faults.append(f"{path}: the faces are wound inside out; flip the normals")
    if unusable := texture_fault(mesh):
        faults.append(f"{path}: {unusable}")
    step = _float32_spacing(mesh)
    edges = mesh.positions[mesh.faces] - mesh.positions[np.roll(mesh.faces, 1, axis=1)]
    edge = float(np.median(np.linalg.norm(edges, axis=2)))
    if step > 1e-3 * edge:
        faults.append(
            f"{path}: the positions were rounded to float32 far from the origin: steps of {step:.2g} on edges of "
            f"{edge:.2g}; move the object to the origin and save it again"
        )
    return faults


def closedness_faults(mesh: Mesh) -> list[str]:
    """Return why the mesh does not bound a solid, a clause each: doubled faces, holes, opposite winding, overlaps."""
    edges = edges_of(mesh.faces)
    if (edges.uses > 2).any() and len(doubled := doubled_faces(mesh.faces)):
        place = _place(mesh, mesh.faces[doubled[0]])
        return [f"{len(doubled)} faces lie on other faces, {place}; remove doubled faces and inner walls"]
    faults = []
    if count := int(edges.open.sum()):
        faults.append(
            f"{count} edges are open, {_place(mesh, edges.ends[edges.open.argmax()])}; expected two faces, or an even "
            f"number, at every edge: {remedy(mesh.positions, mesh.faces, edges)}"
        )
    if count := int(edges.inconsistent.sum()):
        place = _place(mesh, edges.ends[edges.inconsistent.argmax()])
        faults.append(f"{count} edges lie between faces of opposite winding, {place}; make the normals consistent")
    if not faults and len(found := overlapping(mesh.positions, mesh.faces, edges)):
        faults.append(
            f"solids overlap at {len(found)} edges of more than two faces, {_place(mesh, edges.ends[found[0]])}; unite "
            f"them, or move them apart"
        )
    return faults


def _place(mesh: Mesh, vertices: NDArray[np.integer]) -> str:
    points = (", ".join(f"{x:.6g}" for x in mesh.positions[vertex]) for vertex in vertices)
    return "the first between " + " and ".join(f"({point})" for point in points)


def _float32_spacing(mesh: Mesh) -> float:
    """Return the spacing of float32 at the largest coordinate, or 0 if the positions have more precision."""
    if not np.array_equal(mesh.positions, mesh.positions.astype(np.float32)):
        return 0.0
    return float(np.spacing(np.float32(np.abs(mesh.positions).max())))
