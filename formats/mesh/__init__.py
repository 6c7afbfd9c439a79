"""Triangle meshes: one record, read from PLY, OBJ, STL and glTF, written to PLY and OBJ.

May import: the files at the top of `formats`. Begin with `record.py`, then `files.py`, which selects the format by
suffix; each file format has its own module.
"""

from formats.mesh.argument import as_mesh
from formats.mesh.check import check_mesh, closedness_faults
from formats.mesh.files import READABLE, read_mesh, write_mesh
from formats.mesh.record import (
    SPLIT_ANGLE,
    Mesh,
    build_mesh,
    flipped,
    good_normals,
    inconsistent_edges,
    inward_sentence,
    open_edges,
    refuse_inside_out,
    refuse_two_sides,
    signed_volume,
)
from formats.mesh.texture_coordinates import texture_fault, texture_remark

__all__ = [
    "READABLE",
    "SPLIT_ANGLE",
    "Mesh",
    "as_mesh",
    "build_mesh",
    "check_mesh",
    "closedness_faults",
    "flipped",
    "good_normals",
    "inconsistent_edges",
    "inward_sentence",
    "open_edges",
    "read_mesh",
    "refuse_inside_out",
    "refuse_two_sides",
    "signed_volume",
    "texture_fault",
    "texture_remark",
    "write_mesh",
]
