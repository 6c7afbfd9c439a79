"""Triangle meshes: one record, read from PLY, OBJ and glTF, written to PLY.

May import: the files at the top of `formats`. Begin with `record.py`; each file format has a module of its own.
"""

from formats.mesh.record import (
    Mesh,
    build_mesh,
    check_mesh,
    flipped,
    open_edges,
    read_mesh,
    signed_volume,
    torn_edges,
    write_mesh,
)

__all__ = [
    "Mesh",
    "build_mesh",
    "check_mesh",
    "flipped",
    "open_edges",
    "read_mesh",
    "signed_volume",
    "torn_edges",
    "write_mesh",
]
