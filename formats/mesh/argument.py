"""A mesh as an argument: of this package, or of trimesh."""

from typing import Any

from formats.arguments import described
from formats.errors import QueryError, refuse_path
from formats.mesh.record import Mesh


def as_mesh(name: str, value: Any) -> Mesh:
    """A mesh, from one of trimesh too. Raises QueryError that says what was found in place of the argument `name`."""
    refuse_path(name, value, "prt.read_mesh")
    if isinstance(value, Mesh):
        return value
    if all(hasattr(value, each) for each in ("vertices", "faces", "vertex_normals")):
        return Mesh.from_trimesh(value)
    of_record = getattr(value, "mesh", None)
    remedy = "; give its .mesh" if isinstance(of_record, Mesh) else ""
    raise QueryError(f"{name}: expected what prt.read_mesh(path) returns, found {described(value)}{remedy}")
