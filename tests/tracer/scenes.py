"""Small scenes for tests of the path tracer, written to files and read back."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from formats.mesh import Mesh, build_mesh, write_mesh
from formats.scene import Scene, read_scene
from prt_bake.mathematics.directions import fibonacci, random_rotations


def sphere(subdivisions: int = 3) -> Mesh:
    """A unit ball of triangles."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    return build_mesh(np.asarray(ball.vertices), np.asarray(ball.faces))


def lumpy(subdivisions: int = 3) -> Mesh:
    """A closed concave mesh: rays from its surface hit it again."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    v = np.asarray(ball.vertices)
    radius = 1.0 + 0.45 * np.sin(4.0 * v[:, :1]) * np.cos(3.0 * v[:, 1:2])
    return build_mesh(v * radius * [1.0, 0.8, 1.1], np.asarray(ball.faces))


def slab(side: float) -> Mesh:
    """A square box of height 1 about the origin, z up."""
    box = trimesh.creation.box(extents=(side, side, 1.0))
    return build_mesh(np.asarray(box.vertices), np.asarray(box.faces))


def moved(mesh: Mesh, scale: float, offset: ArrayLike = 0.0) -> Mesh:
    """The mesh scaled about the origin, then shifted."""
    return build_mesh(np.asarray(mesh.positions) * scale + np.asarray(offset), np.asarray(mesh.faces))


def with_uv(mesh: Mesh) -> Mesh:
    """The mesh with longitude and height as texture coordinates, including a seam."""
    v = np.asarray(mesh.positions)
    turn = np.arctan2(v[:, 1], v[:, 0]) / (2.0 * np.pi) % 1.0
    height = (v[:, 2] - v[:, 2].min()) / np.ptp(v[:, 2])
    return Mesh(mesh.positions, mesh.faces, mesh.normals, uv=np.stack([turn, height], axis=1))


def make_scene(folder: Path, mesh: Mesh, normals: str = "face", bounds: ArrayLike | None = None, **given: Any) -> Scene:
    """Write mesh, grids and TOML into `folder` and read the scene.

    `given`: eta, roughness, sigma_t, albedo, phase_g; sigma_t and albedo may be grids, over `bounds` or the mesh's box.
    """
    write_mesh(mesh, folder / "object.ply")
    values: dict[str, Any] = {"phase_g": float(given.pop("phase_g", 0.0))}
    for name, usual in (("sigma_t", 4.0), ("albedo", 0.9)):
        array = np.asarray(given.pop(name, usual), np.float64)
        if array.ndim >= 3:
            np.save(folder / f"{name}.npy", array)
            values[name] = f"{name}.npy"
            low, high = mesh.positions.min(axis=0), mesh.positions.max(axis=0)
            values["bounds"] = np.asarray(bounds if bounds is not None else [low, high]).tolist()
        else:
            values[name] = array.tolist()
    interface = {"eta": given.pop("eta", 1.0), "roughness": given.pop("roughness", 0.0), "normals": normals}
    assert not given, f"no key of a scene: {sorted(given)}"
    tables = {"object": {"mesh": "object.ply"}, "interface": interface, "medium": values}
    text = "\n".join(
        f"[{name}]\n" + "\n".join(f"{key} = {json.dumps(value)}" for key, value in table.items())
        for name, table in tables.items()
    )
    (folder / "scene.toml").write_text(text)
    return read_scene(folder / "scene.toml")


def unit_directions(count: int, seed: int) -> np.ndarray:
    """Uniform directions [count,3]."""
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return np.asarray(d / np.linalg.norm(d, axis=1, keepdims=True))


def rotated_lattices(count: int, directions: int, seed: int) -> np.ndarray:
    """`count` randomly rotated lattices of directions [count,directions,3]; each direction alone is uniform."""
    return np.einsum("nij,dj->ndi", random_rotations(count, seed), fibonacci(directions))


def queries(mesh: Mesh, count: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions on faces [N,3], directions to the eye above them [N,3], and normals [N,3]."""
    generator = np.random.default_rng(seed)
    areas = np.asarray(mesh.face_areas)
    faces = generator.choice(len(mesh.faces), count, p=areas / areas.sum())
    weights = generator.dirichlet([1, 1, 1], count)
    normals = np.asarray(mesh.face_normals)[faces]
    outgoing = unit_directions(count, seed + 1)
    outgoing *= np.sign(np.sum(outgoing * normals, axis=1, keepdims=True))
    return np.einsum("nk,nkc->nc", weights, mesh.positions[mesh.faces[faces]]), outgoing, normals


def blotches(shape: tuple[int, ...], contrast: float, seed: int) -> np.ndarray:
    """A random grid of the values 1 and 1 / contrast with equal probability."""
    return np.where(np.random.default_rng(seed).random(shape) < 0.5, 1.0, 1.0 / contrast)
