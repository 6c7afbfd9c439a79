"""Small scenes for the path tracer's tests, written as files and read back as any user's are."""

import json

import numpy as np
import trimesh

from formats.mesh import build_mesh, write_mesh
from formats.scene import read_scene


def sphere(subdivisions=3):
    """A unit ball of triangles."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    return build_mesh(np.asarray(ball.vertices), np.asarray(ball.faces))


def lumpy(subdivisions=3):
    """A closed mesh with hollows: rays from its surface meet it again."""
    v, faces = (lambda ball: (np.asarray(ball.vertices), np.asarray(ball.faces)))(
        trimesh.creation.icosphere(subdivisions=subdivisions)
    )
    radius = 1.0 + 0.45 * np.sin(4.0 * v[:, :1]) * np.cos(3.0 * v[:, 1:2])
    return build_mesh(v * radius * [1.0, 0.8, 1.1], faces)


def make_scene(folder, mesh, sigma_t=4.0, albedo=0.9, phase_g=0.0, eta=1.0, roughness=0.0, normals="face", bounds=None):
    """Write mesh, grids and TOML into `folder` and read the scene; sigma_t and albedo may be grids."""
    write_mesh(mesh, folder / "object.ply")
    values = {"phase_g": float(phase_g)}
    for name, value in (("sigma_t", sigma_t), ("albedo", albedo)):
        array = np.asarray(value, np.float64)
        if array.ndim >= 3:
            np.save(folder / f"{name}.npy", array)
            values[name] = f"{name}.npy"
            low, high = mesh.positions.min(axis=0), mesh.positions.max(axis=0)
            values["bounds"] = np.asarray(bounds if bounds is not None else [low, high]).tolist()
        else:
            values[name] = array.tolist()
    interface = {"eta": float(eta), "roughness": float(roughness), "normals": normals}
    tables = {"object": {"mesh": "object.ply"}, "interface": interface, "medium": values}
    text = "\n".join(
        f"[{name}]\n" + "\n".join(f"{key} = {json.dumps(value)}" for key, value in table.items())
        for name, table in tables.items()
    )
    (folder / "scene.toml").write_text(text)
    return read_scene(folder / "scene.toml")


def unit_directions(count, seed):
    """Uniform directions [count,3]."""
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def queries(mesh, count, seed):
    """Positions on faces [N,3], directions to the eye above them [N,3], and the normals [N,3]."""
    generator = np.random.default_rng(seed)
    faces = generator.choice(len(mesh.faces), count, p=mesh.face_areas / mesh.face_areas.sum())
    weights = generator.dirichlet([1, 1, 1], count)
    normals = mesh.face_normals[faces]
    outgoing = unit_directions(count, seed + 1)
    outgoing *= np.sign(np.sum(outgoing * normals, axis=1, keepdims=True))
    return np.einsum("nk,nkc->nc", weights, mesh.positions[mesh.faces[faces]]), outgoing, normals
