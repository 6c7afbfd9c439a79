"""Checks that hold for every estimate in any scene: finite numbers, signs, energy conservation."""

import numpy as np

from formats.scene import Scene
from prt_bake.geometry.surface import Surface
from prt_bake.tracer.estimate import Estimate, estimate_coefficients, estimate_transport
from prt_bake.tracer.light_samples import sample_exits
from prt_bake.tracer.prepared import smooth_part
from tests.tracer.rough_slab import fresnel

SQRT_4_PI = np.sqrt(4.0 * np.pi)


def assert_sound(estimate: Estimate) -> None:
    """Assert finite numbers, plausible errors and transmittances, and no truncated walk."""
    for name in ("mean", "standard_error", "unscattered", "lost"):
        assert np.isfinite(getattr(estimate, name)).all(), name
    assert (estimate.standard_error >= 0.0).all()
    assert estimate.unscattered.min() >= 0.0
    # If channels differ, a walk carries up to three times as much in one of them, which shows as noise.
    assert estimate.unscattered.max() <= (1.0 + 1e-9 if estimate.unscattered.ndim == 1 else 3.0 + 1e-9)
    np.testing.assert_array_equal(estimate.lost, 0.0)


def white_sky(
    scene: Scene, positions: np.ndarray, outgoing: np.ndarray, paths: int, seed: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Radiance of each query under a sky of radiance 1, including unscattered light: mean and error [N,3]."""
    result = estimate_coefficients(scene, positions, outgoing, 0, paths, seed)
    assert_sound(result)
    assert result.mean.min() >= 0.0
    return SQRT_4_PI * result.mean[:, 0] + result.unscattered.reshape(
        len(result.mean), -1
    ), SQRT_4_PI * result.standard_error[:, 0]


def transmitted_share(scene: Scene, positions: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
    """1 − F(ωo) [N] of a smooth boundary on the face of each query."""
    normals = np.asarray(scene.mesh.face_normals)[Surface(scene.mesh).locate(positions, outgoing).faces]
    return np.asarray(1.0 - fresnel(np.sum(outgoing * normals, axis=1), 1.0, scene.eta))


def assert_furnace(scene: Scene, positions: np.ndarray, outgoing: np.ndarray, paths: int, rtol: float = 1e-5) -> None:
    """White furnace behind a smooth or index-matched boundary: only the reflection at x is missing."""
    total, _error = white_sky(scene, positions, outgoing, paths)
    expected = transmitted_share(scene, positions, outgoing)
    np.testing.assert_allclose(total, np.repeat(expected[:, None], 3, axis=1), rtol=rtol, atol=1e-12)


def cap(axis: np.ndarray, degrees: float, count: int, seed: int) -> np.ndarray:
    """Uniform directions [count,3] within an angle of an axis."""
    generator = np.random.default_rng(seed)
    cosine = 1.0 - generator.random(count) * (1.0 - np.cos(np.radians(degrees)))
    turn, sine = 2.0 * np.pi * generator.random(count), np.sqrt(1.0 - cosine**2)
    across = np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[0]) < 0.9 else [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    other = np.cross(axis, across)
    directions = cosine[:, None] * axis + sine[:, None] * (
        np.cos(turn)[:, None] * across + np.sin(turn)[:, None] * other
    )
    return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))


def into_cap(
    scene: Scene,
    position: np.ndarray,
    outgoing: np.ndarray,
    axis: np.ndarray,
    degrees: float,
    *,
    paths: int,
    exits: int,
    batches: int = 24,
    directions: int = 16,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """∫ Ŝ dωi [3] over a cap by connections, its error, and the same by exits into it, with their error."""
    incident = cap(axis, degrees, batches * directions, 3).reshape(batches, directions, 3)
    result = estimate_transport(
        scene, np.tile(position, (batches, 1)), np.tile(outgoing, (batches, 1)), incident, paths, 2
    )
    solid_angle = 2.0 * np.pi * (1.0 - np.cos(np.radians(degrees)))
    means = solid_angle * result.mean.mean(axis=1)
    # Batches are independent. An error from 24 of them is itself known to a seventh, hence the factor.
    error = 1.3 * means.std(axis=0, ddof=1) / np.sqrt(batches)
    location = Surface(scene.mesh).locate(position[None], outgoing[None])
    keys = np.zeros(1, np.uint64)
    walked = sample_exits(scene, location.faces, location.barycentric, outgoing[None], keys, exits, 5)
    into = walked.throughput[0] * (walked.directions[0] @ axis > np.cos(np.radians(degrees)))[:, None]
    return means.mean(axis=0), error, into.mean(axis=0), into.std(axis=0) / np.sqrt(exits)


def has_connections(scene: Scene) -> bool:
    """Whether connections exist in the scene."""
    return smooth_part(scene) is None
