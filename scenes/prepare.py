"""Prepares a mesh for a scene: `python -m scenes.prepare IN OUT --size 2 --center 0,0,0`.

Drops faces without area, and moves and scales the mesh to the given centre and longest side. Refuses a mesh with holes:
close them first.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

from formats.errors import MeshError, PrtbakeError
from formats.mesh import build_mesh, flipped, inconsistent_edges, open_edges, read_mesh, signed_volume, write_mesh


def prepare(source: Path, out: Path, size: float, center: tuple[float, float, float]) -> None:
    """Write the prepared mesh.

    Raises:
        MeshError: the mesh is damaged, open or inconsistently oriented.
        StorageError: the file is missing, or the output cannot be written.
    """
    mesh = read_mesh(source, drop_flat_faces=True)
    if faults := open_edges(mesh) + inconsistent_edges(mesh):
        raise MeshError(
            f"{source}: {faults} edges are open or inconsistent; close the holes first (MeshLab: Screened Poisson)"
        )
    low, high = mesh.bounds
    scale = size / float((high - low).max())
    placed = build_mesh((mesh.positions - mesh.center) * scale + np.asarray(center), mesh.faces)
    write_mesh(flipped(placed) if signed_volume(placed) < 0 else placed, out)


def _point(text: str) -> tuple[float, float, float]:
    x, y, z = (float(part) for part in text.split(","))
    return x, y, z


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Place and scale a closed mesh for a scene.")
    parser.add_argument("source", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--size", type=float, default=2.0, help="longest side of its box, in scene units")
    parser.add_argument("--center", type=_point, default=(0.0, 0.0, 0.0), help="middle of its box, as x,y,z")
    arguments = parser.parse_args()
    try:
        prepare(arguments.source, arguments.out, arguments.size, arguments.center)
    except PrtbakeError as error:
        sys.exit(f"prepare: {error}")
