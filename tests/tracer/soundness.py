"""What every estimate must keep in any scene, however extreme: numbers, signs, energy."""

import numpy as np

from formats.scene import Scene
from prt_bake.geometry.surface import Surface
from prt_bake.tracer.estimate import Estimate, estimate_coefficients, estimate_transport
from prt_bake.tracer.light_samples import walk_out
from prt_bake.tracer.prepared import smooth_part
from tests.tracer.rough_slab import fresnel

SQRT_4_PI = np.sqrt(4.0 * np.pi)


def assert_sound(estimate: Estimate) -> None:
    """Numbers everywhere, errors and shares that can be, and no walk cut."""
    for name in ("mean", "standard_error", "unscattered", "lost"):
        assert np.isfinite(getattr(estimate, name)).all(), name
    assert (estimate.standard_error >= 0.0).all()
    assert estimate.unscattered.min() >= 0.0
    # Where channels differ, a walk carries up to three times as much in one of them, and shares know this noise.
    assert estimate.unscattered.max() <= (1.0 + 1e-9 if estimate.unscattered.ndim == 1 else 3.0 + 1e-9)
    np.testing.assert_array_equal(estimate.lost, 0.0)


def white_sky(
    scene: Scene, positions: np.ndarray, outgoing: np.ndarray, paths: int, seed: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """What a sky of radiance 1 makes of each query, unscattered light counted: mean and error [N,3]."""
    seen = estimate_coefficients(scene, positions, outgoing, 0, paths, seed)
    assert_sound(seen)
    assert seen.mean.min() >= 0.0
    return SQRT_4_PI * seen.mean[:, 0] + seen.unscattered.reshape(len(seen.mean), -1), SQRT_4_PI * seen.standard_error[
        :, 0
    ]


def let_in(scene: Scene, positions: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
    """1 − F(ωo) [N] of a smooth boundary, on the face that each query is taken to."""
    normals = np.asarray(scene.mesh.face_normals)[Surface(scene.mesh).locate(positions, outgoing).faces]
    return np.asarray(1.0 - fresnel(np.sum(outgoing * normals, axis=1), 1.0, scene.eta))


def assert_furnace(scene: Scene, positions: np.ndarray, outgoing: np.ndarray, paths: int, rtol: float = 1e-5) -> None:
    """White matter and a smooth or index-matched boundary: each walk comes back whole, but for the reflection at x."""
    total, _error = white_sky(scene, positions, outgoing, paths)
    due = let_in(scene, positions, outgoing)
    np.testing.assert_allclose(total, np.repeat(due[:, None], 3, axis=1), rtol=rtol, atol=1e-12)


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
    lots: int = 24,
    directions: int = 16,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """∫ Ŝ dωi [3] over a cap by connections, its error, and the same from the exits that fall into it, with theirs."""
    incident = cap(axis, degrees, lots * directions, 3).reshape(lots, directions, 3)
    seen = estimate_transport(scene, np.tile(position, (lots, 1)), np.tile(outgoing, (lots, 1)), incident, paths, 2)
    solid_angle = 2.0 * np.pi * (1.0 - np.cos(np.radians(degrees)))
    means = solid_angle * seen.mean.mean(axis=1)
    # Lots share neither walks nor directions; twenty-four know their own error to a seventh, which is allowed for.
    error = 1.3 * means.std(axis=0, ddof=1) / np.sqrt(lots)
    location = Surface(scene.mesh).locate(position[None], outgoing[None])
    keys = np.zeros(1, np.uint64)
    walked = walk_out(scene, location.faces, location.barycentric, outgoing[None], keys, exits, 5)
    into = walked.throughput[0] * (walked.directions[0] @ axis > np.cos(np.radians(degrees)))[:, None]
    return means.mean(axis=0), error, into.mean(axis=0), into.std(axis=0) / np.sqrt(exits)


def connects(scene: Scene) -> bool:
    """Whether connections exist in the scene."""
    return smooth_part(scene) is None
