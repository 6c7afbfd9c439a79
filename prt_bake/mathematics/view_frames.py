"""Harmonics in the frame of a view: z along the normal, x towards the eye, laid into the surface.

What a lattice of directions misses at a vertex moves as the eye does, as a mirror image does: in this frame the errors
of all view bins of a whole object hang together much alike (on a trained network 78 % of their variance lies along one
line among nine harmonics, 30 % in the world's frame).

A rotation is z, y, z by turns, and one about y is one about z between two fixed ones, so that none needs more than
sines, cosines and two products with one matrix. Source: Pinchon and Hoggan, "Rotation matrices for real spherical
harmonics" (2007).
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from formats.mesh import Mesh
from prt_bake.mathematics import sh
from prt_bake.mathematics.sphere import tangent_frame

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_TINY = 1e-12
_Z_TO_Y = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True)
class ViewFrames:
    """Of the vertices of a mesh, by their unit normals and tangents [V,3]."""

    normals: Array
    tangents: Array

    def axes(self, vertices: Index, outgoing: Array) -> Array:
        """Rotations [M,3,3] from the world into the frames of these vertices [M] as seen along unit `outgoing` [M,3];
        along the normal x is the tangent.
        """
        normal = np.asarray(self.normals, np.float64)[vertices]
        x = outgoing - np.einsum("mi,mi->m", outgoing, normal)[:, None] * normal
        length = np.linalg.norm(x, axis=1, keepdims=True)
        x = np.where(length > _TINY, x / np.maximum(length, _TINY), np.asarray(self.tangents, np.float64)[vertices])
        return np.stack([x, np.cross(normal, x), normal], axis=1)

    def in_view(self, vertices: Index, outgoing: Array, coefficients: Array) -> Array:
        """Coefficients [M,K,C] of the world's frame in those frames."""
        return turned(self.axes(vertices, outgoing), coefficients)

    def matrices(self, vertices: Index, outgoing: Array, count: int) -> Array:
        """What takes K = `count` coefficients there, [M,K,K]."""
        return self.in_view(vertices, outgoing, np.broadcast_to(np.eye(count), (len(vertices), count, count)))


def frames_of(mesh: Mesh) -> ViewFrames:
    """Those of the vertices of a mesh, whose tangents are those of a bake."""
    return ViewFrames(mesh.normals, tangent_frame(mesh.normals))


def turned(rotations: Array, coefficients: Array) -> Array:
    """Coefficients [M,K,C] of functions that are turned by rotations [M,3,3]."""
    count = coefficients.shape[1]
    if count == 1:
        return np.array(coefficients)
    first, second, third = _angles(rotations)
    to_y = _between(sh.degree_of(count))
    turned = to_y.T @ _about_z(third, coefficients)
    turned = to_y @ _about_z(second, turned)
    return _about_z(first, turned)


def _angles(rotations: Array) -> tuple[Array, Array, Array]:
    """Angles [M] about z, y and z, the last first, that these rotations [M,3,3] are made of."""
    across = np.hypot(rotations[:, 2, 0], rotations[:, 2, 1])
    upright = across < _TINY
    second = np.arctan2(across, rotations[:, 2, 2])
    third = np.where(upright, 0.0, np.arctan2(rotations[:, 2, 1], -rotations[:, 2, 0]))
    whole = np.arctan2(-rotations[:, 0, 1], rotations[:, 1, 1])
    return np.where(upright, whole, np.arctan2(rotations[:, 1, 2], rotations[:, 0, 2])), second, third


def _about_z(angle: Array, coefficients: Array) -> Array:
    """Coefficients [M,K,C] turned about z by angles [M]."""
    orders, opposite = _orders(coefficients.shape[1])
    turns = np.arange(int(orders.max()) + 1)[None] * angle[:, None]
    cosine, sine = np.cos(turns)[:, np.abs(orders), None], np.sin(turns)[:, np.abs(orders), None]
    return np.asarray(cosine * coefficients - np.sign(orders)[:, None] * sine * coefficients[:, opposite])


@lru_cache(maxsize=32)
def _orders(count: int) -> tuple[Index, Index]:
    """The order m of each harmonic, and where the one of −m stands."""
    degrees = np.sqrt(np.arange(count)).astype(np.int64)
    orders = np.arange(count) - degrees * (degrees + 1)
    return orders, degrees * (degrees + 1) - orders


@lru_cache(maxsize=32)
def _between(degree: int) -> Array:
    return np.asarray(sh.rotation(_Z_TO_Y, degree))
