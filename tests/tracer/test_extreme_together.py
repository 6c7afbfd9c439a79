"""Combined limits: sharp phase functions behind narrow interfaces, textures, nested high indices, tiny meshes.

z-tests of false-alarm rate `significance.FALSE_ALARM` each, about 15 of them.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from formats.mesh import Mesh
from formats.scene import Scene
from prt_bake.tracer.estimate import estimate_transport
from tests.mathematics.significance import assert_agree, largest_z
from tests.tracer.nested_scenes import CLEAR, nested_scene
from tests.tracer.scenes import lumpy, make_scene, moved, queries, slab, sphere, unit_directions, with_uv
from tests.tracer.soundness import assert_furnace, assert_sound, has_connections, into_cap, white_sky

pytestmark = pytest.mark.statistics

WHITE: dict[str, Any] = {"sigma_t": 3.0, "albedo": 1.0}
SHARP: dict[str, Any] = {"sigma_t": 5.0, "albedo": 1.0, "phase_g": 0.99}
RARE = np.where(np.random.default_rng(5).random((16, 16, 16)) < 0.01, 1e4, 0.0)
BOX = [[-0.6] * 3, [0.6] * 3]
NARROW: dict[str, Any] = {"eta": 1.5, "roughness": 0.01}


def textured(folder: Path, medium: dict[str, Any]) -> Scene:
    """A ball with a texture of roughness from 0.01 to 1."""
    return nested_scene(
        folder, with_uv(sphere(3)), medium, eta=2.5, roughness=np.geomspace(0.01, 1.0, 64).reshape(8, 8)
    )


def nest(folder: Path, inner: dict[str, Any], medium: dict[str, Any], **outer: Any) -> Scene:
    part = {"mesh": moved(lumpy(2), 0.4), "name": "inner", "interface": inner, "medium": medium}
    return nested_scene(folder, sphere(2), WHITE, (part,), **outer)


SCENES: dict[str, Any] = {
    "g 0.99 behind roughness 0.01": lambda folder: make_scene(folder, lumpy(2), **SHARP, **NARROW),
    "g -0.99 behind roughness 1 of eta 2.5": lambda folder: make_scene(
        folder, lumpy(2), **SHARP | {"phase_g": -0.99}, eta=2.5, roughness=1.0
    ),
    "a texture of roughness": lambda folder: textured(folder, WHITE),
    "g 0.99 behind a texture of roughness": lambda folder: textured(folder, SHARP),
    "rough 2.5 in rough 1.5": lambda folder: nest(folder, {"eta": 2.5, "roughness": 0.01}, WHITE, **NARROW),
    "smooth 2.5 in rough 1.5": lambda folder: nest(folder, {"eta": 2.5}, WHITE, **NARROW),
    "empty but for cells of 1e4, coloured": lambda folder: make_scene(
        folder, lumpy(2), sigma_t=RARE[..., None] * [1.0, 0.01, 0.0], albedo=0.9, **NARROW
    ),
    "a micron, interpolated normals": lambda folder: make_scene(
        folder, moved(lumpy(1), 1e-6), "vertex", sigma_t=3e6, albedo=1.0, **NARROW
    ),
    "a thousand kilometres, interpolated normals": lambda folder: make_scene(
        folder, moved(lumpy(1), 1e6), "vertex", sigma_t=3e-6, albedo=1.0, eta=2.5, roughness=0.01
    ),
}


@pytest.mark.parametrize("name", SCENES)
def test_combined_extremes_are_sound(tmp_path: Path, name: str) -> None:
    """Finite numbers, and no gain of energy."""
    scene = SCENES[name](tmp_path)
    positions, outgoing, _ = queries(scene.mesh, 12, 3)
    total, error = white_sky(scene, positions, outgoing, 256)
    assert (total <= 1.0 + largest_z(total.size) * error + 1e-9).all()
    assert (total > 0.0).any(axis=1).all()
    assert has_connections(scene)
    incident = np.stack([-outgoing, outgoing, *unit_directions(24, 4).reshape(2, 12, 3)], axis=1)
    assert_sound(estimate_transport(scene, positions, outgoing, incident, 128, 1))


@pytest.mark.parametrize("name", ["a texture of roughness", "g -0.99 behind roughness 1 of eta 2.5"])
def test_connections_agree_with_exits(tmp_path: Path, name: str) -> None:
    scene = SCENES[name](tmp_path)
    positions, outgoing, normals = queries(scene.mesh, 3, 6)
    for position, eye, normal in zip(positions, outgoing, normals, strict=True):
        for axis in (normal, -eye):
            assert_agree(*into_cap(scene, position, eye, axis, 60.0, paths=300, exits=30_000))


@pytest.mark.parametrize(
    ("inner", "medium"), [(2.5, WHITE), (1.0, CLEAR), (2.5, {"sigma_t": 1e-2 * RARE, "albedo": 1.0, "bounds": BOX})]
)
def test_nested_high_indices_conserve_energy(tmp_path: Path, inner: float, medium: dict[str, Any]) -> None:
    """Total internal reflection at both boundaries; the inner medium is white, a vacuum, or has rare dense cells."""
    scene = nest(tmp_path, {"eta": inner}, medium, eta=1.5 if inner > 2.0 else 2.5)
    assert_furnace(scene, *queries(scene.mesh, 12, 3)[:2], paths=128)


@pytest.mark.parametrize("interface", [{}, {"eta": 1.5}, NARROW])
@pytest.mark.parametrize("mesh", [lumpy(1), slab(1.0), moved(lumpy(2), 1e-6)], ids=["hollows", "cube", "micron"])
def test_grazing_views_of_vertices(tmp_path: Path, mesh: Mesh, interface: dict[str, Any]) -> None:
    """ωo·n = 1e-3 on the face of a vertex that faces the eye most."""
    size = float(np.ptp(mesh.positions, axis=0).max())
    scene = make_scene(tmp_path, mesh, sigma_t=6.0 / size, albedo=1.0, **interface)
    places, outgoing = _grazing_at_vertices(mesh)
    assert len(places) > 8
    if "roughness" not in interface:
        # At this angle the float32 rounding of a normal is magnified a thousand times.
        assert_furnace(scene, places, outgoing, paths=128, rtol=1e-3)
        return
    total, error = white_sky(scene, places, outgoing, 256)
    assert (total <= 1.0 + largest_z(total.size) * error).all()
    assert_sound(estimate_transport(scene, places, outgoing, unit_directions(len(places), 3), 128, 1))


def _grazing_at_vertices(mesh: Mesh, cosine: float = 1e-3, count: int = 24) -> tuple[np.ndarray, np.ndarray]:
    places, outgoing = [], []
    normals = np.asarray(mesh.face_normals)
    for vertex in range(min(12, len(mesh.positions))):
        about = normals[(mesh.faces == vertex).any(axis=1)]
        for normal in about:
            across = np.cross(normal, [0.3, 0.5, 0.8])
            across /= np.linalg.norm(across)
            other = np.cross(normal, across)
            for turn in np.linspace(0.0, 2.0 * np.pi, 6, endpoint=False):
                eye = cosine * normal + np.sqrt(1.0 - cosine**2) * (np.cos(turn) * across + np.sin(turn) * other)
                if abs((about @ eye).max() - cosine) < 1e-9:
                    places.append(mesh.positions[vertex])
                    outgoing.append(eye)
    return np.array(places)[:count], np.array(outgoing)[:count]
