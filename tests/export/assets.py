"""An asset for the tests of exports: it varies smoothly with the vertex, the view, the harmonic and the channel."""

import numpy as np
import trimesh

from formats.asset import Asset
from formats.mesh import Mesh
from prt_bake.mathematics import sh, sphere
from tests.shading.assets import asset_of

RINGS, SECTORS = 8, 32


def ball(subdivisions: int = 2) -> Mesh:
    solid = trimesh.creation.icosphere(subdivisions=subdivisions)
    solid.apply_transform(np.diag([1.0, 1.5, 0.8, 1.0]))
    return Mesh(
        np.asarray(solid.vertices) + np.array([0.3, -2.0, 5.0]),
        np.asarray(solid.faces),
        np.asarray(solid.vertex_normals),
    )


def smooth_asset(mesh: Mesh | None = None, degree: int = 2, seed: int = 0, **others) -> Asset:
    """Coefficients of a sharp function of the view in object space: all degrees of the view occur."""
    mesh = mesh or ball()
    random = np.random.default_rng(seed)
    axes = random.normal(size=(sh.count(degree), 3, 3))
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    directions = view_directions(mesh)
    size = 0.15 * random.normal(size=(sh.count(degree), 3))
    size[0] = [1.0, 0.8, 0.6]
    values = np.exp(1.5 * np.einsum("vbi,kci->vbkc", directions, axes)) * size
    values *= 1.0 + 0.3 * np.sin(mesh.positions[:, :1, None, None] * 3.0)
    return asset_of(mesh, values.astype(np.float32), RINGS, SECTORS, degree, **others)


def view_directions(mesh: Mesh) -> np.ndarray:
    """The view bins in object space [V,B,3]."""
    tangents = sphere.tangent_frame(mesh.normals)
    return sphere.to_world(sphere.view_bins(RINGS, SECTORS)[None], mesh.normals[:, None], tangents[:, None])
