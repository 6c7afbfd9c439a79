"""Scenes: one closed object, its surface and the medium inside, from a TOML file checked key by key."""

import dataclasses
import hashlib
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from formats.errors import SceneError
from formats.mesh import Mesh, flipped, open_edges, read_mesh, signed_volume, torn_edges
from formats.scene_grid import read_grid
from formats.scene_schema import MediumTable, SceneFile, parse_scene


@dataclass(frozen=True, eq=False)
class Scene:
    """A scene with everything it names loaded. Lengths are in scene units, `sigma_t` is per scene unit.

    Attributes:
        path: the TOML file.
        tables: the file's tables as checked.
        mesh_path: the mesh file.
        mesh: closed, wound consistently, faces counter-clockwise seen from outside.
        flipped: whether the file had the faces wound inside out.
        up: the axis that points up.
        unit: name of the unit of length.
        eta: absolute index of refraction inside (outside: 1); 1 is index-matched.
        roughness: GGX alpha; 0 is smooth.
        normals: which normals the interface uses, "face" or "vertex".
        sigma_t: extinction, a number or a float64 grid [Z,Y,X].
        albedo: single-scattering albedo in [0,1], float64 [3] or a grid [Z,Y,X] or [Z,Y,X,3].
        phase_g: mean cosine of the Henyey–Greenstein phase function.
        bounds: float64 [2,3], lowest and highest corner of the grids' box; None where there is no grid.
        content_hash: SHA-256 of all that decides the transport: mesh, interface, medium, grids.
    """

    path: Path
    tables: SceneFile
    mesh_path: Path
    mesh: Mesh
    flipped: bool
    up: Literal["y", "z"]
    unit: str
    eta: float
    roughness: float
    normals: Literal["face", "vertex"]
    sigma_t: float | NDArray[np.float64]
    albedo: NDArray[np.float64]
    phase_g: float
    bounds: NDArray[np.float64] | None
    content_hash: str = ""


def read_scene(path: str | os.PathLike[str]) -> Scene:
    """Read a scene file and the mesh and grids it names, relative to itself.

    Raises:
        SceneError: an unknown key, a value out of range, a grid that does not fit, a mesh that is not closed; the
            message names the key.
        MeshError: the mesh itself is damaged.
        StorageError: a file is missing.
    """
    path = Path(path)
    tables = parse_scene(path)
    if tables.inside:
        raise SceneError(f"{path}: inside: objects inside the object are not supported yet; remove [[inside]]")
    mesh_path = path.parent / tables.object.mesh
    mesh, was_flipped = _closed_mesh(mesh_path, path)
    sigma_t, albedo = _sigma_t(tables.medium, path), _albedo(tables.medium, path)
    has_grid = isinstance(tables.medium.sigma_t, str) or isinstance(tables.medium.albedo, str)
    scene = Scene(
        path=path,
        tables=tables,
        mesh_path=mesh_path,
        mesh=mesh,
        flipped=was_flipped,
        up=tables.object.up,
        unit=tables.object.unit,
        eta=tables.interface.eta,
        roughness=tables.interface.roughness,
        normals=tables.interface.normals,
        sigma_t=sigma_t,
        albedo=albedo,
        phase_g=tables.medium.phase_g,
        bounds=_bounds(tables.medium, path) if has_grid else None,
    )
    return dataclasses.replace(scene, content_hash=_content_hash(scene))


def _closed_mesh(mesh_path: Path, path: Path) -> tuple[Mesh, bool]:
    mesh = read_mesh(mesh_path)
    if count := open_edges(mesh):
        raise SceneError(
            f"{path}: object.mesh: {mesh_path} is not closed: {count} edges are not shared by exactly two faces; "
            f"close the holes, or leave parts out that touch"
        )
    if count := torn_edges(mesh):
        raise SceneError(
            f"{path}: object.mesh: {mesh_path} has {count} edges between faces wound against one another; make "
            f"its normals consistent"
        )
    return (flipped(mesh), True) if signed_volume(mesh) < 0 else (mesh, False)


def _sigma_t(medium: MediumTable, path: Path) -> float | NDArray[np.float64]:
    if not isinstance(medium.sigma_t, str):
        return medium.sigma_t
    grid = read_grid(path, "medium.sigma_t", medium.sigma_t, highest=np.inf)
    if grid.ndim == 4:
        raise SceneError(
            f"{path}: medium.sigma_t: {medium.sigma_t} has shape {list(grid.shape)}; extinction by channel is not "
            f"supported yet, give a grid [Z,Y,X]"
        )
    return grid


def _albedo(medium: MediumTable, path: Path) -> NDArray[np.float64]:
    if isinstance(medium.albedo, str):
        return read_grid(path, "medium.albedo", medium.albedo, highest=1.0)
    return np.broadcast_to(np.asarray(medium.albedo, np.float64), 3).copy()


def _bounds(medium: MediumTable, path: Path) -> NDArray[np.float64]:
    if medium.bounds is None:
        raise SceneError(
            f"{path}: medium.bounds: is missing; a grid needs its box, as in bounds = [[-1, -1, -1], [1, 1, 1]]"
        )
    return np.array(medium.bounds, np.float64)


def _content_hash(scene: Scene) -> str:
    numbers = [scene.mesh.content_hash, scene.eta, scene.roughness, scene.normals, scene.phase_g]
    digest = hashlib.sha256(json.dumps(numbers).encode())
    for values in (scene.sigma_t, scene.albedo, scene.bounds):
        array = np.zeros(0) if values is None else np.asarray(values, "<f8")
        digest.update(json.dumps(array.shape).encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
