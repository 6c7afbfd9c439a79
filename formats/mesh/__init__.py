"""Triangle meshes: one record, read from PLY, OBJ and glTF, written to PLY and OBJ.

May import: the files at the top of `formats`. Begin with `record.py`; each file format has its own module.
"""

from formats.mesh.record import (
    Mesh,
    build_mesh,
    check_mesh,
    flipped,
    inconsistent_edges,
    open_edges,
    read_mesh,
    signed_volume,
    write_mesh,
)

__all__ = [
    "Mesh",
    "build_mesh",
    "check_mesh",
    "flipped",
    "inconsistent_edges",
    "open_edges",
    "read_mesh",
    "signed_volume",
    "write_mesh",
]
