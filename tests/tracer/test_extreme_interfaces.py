"""Boundaries at their limits: extreme indices and roughnesses, index 1 ± ε, total reflection, and touching parts.

z-tests of false-alarm rate `significance.FALSE_ALARM` each, about 15 of them.
"""

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from formats.mesh import Mesh
from formats.scene import Scene
from prt_bake.tracer import prepared
from prt_bake.tracer.estimate import estimate_coefficients, estimate_transport
from tests import ROOT
from tests.mathematics.significance import assert_agree, largest_z
from tests.tracer.nested_scenes import CLEAR, nested_scene
from tests.tracer.scenes import lumpy, make_scene, moved, queries, slab, sphere, unit_directions
from tests.tracer.soundness import SQRT_4_PI, assert_furnace, assert_sound, into_cap, transmitted_share, white_sky

pytestmark = pytest.mark.statistics

WHITE: dict[str, Any] = {"sigma_t": 3.0, "albedo": 1.0}
HAZE: dict[str, Any] = {"sigma_t": 3.0, "albedo": [0.9, 0.6, 0.99]}
INDICES = [0.25, 0.7, 1.0 - 1e-6, 1.0 + 1e-10, 1.0 + 1e-6, 1.01, 2.5, 4.0]


@pytest.mark.parametrize("eta", INDICES)
def test_smooth_boundaries_of_any_index_conserve_energy(tmp_path: Path, eta: float) -> None:
    """Below index 1 most views are totally reflected at x and see nothing."""
    scene = make_scene(tmp_path, lumpy(2), **WHITE, eta=eta)
    positions, outgoing, _ = queries(scene.mesh, 16, 3)
    assert_furnace(scene, positions, outgoing, paths=64)
    if eta < 0.5:
        assert (transmitted_share(scene, positions, outgoing) == 0.0).sum() > 8


@pytest.mark.parametrize("roughness", [1e-5, 1e-3, 0.01, 1.0])
@pytest.mark.parametrize("eta", INDICES)
def test_rough_boundaries_of_any_index_are_sound(tmp_path: Path, eta: float, roughness: float) -> None:
    """Finite numbers, and no more energy than enters."""
    scene = make_scene(tmp_path, lumpy(2), **WHITE, eta=eta, roughness=roughness)
    positions, outgoing, _ = queries(scene.mesh, 8, 3)
    total, error = white_sky(scene, positions, outgoing, 256)
    assert (total <= 1.0 + largest_z(total.size) * error + 1e-9).all()
    if roughness >= 1e-4:
        incident = np.stack([-outgoing, outgoing, *unit_directions(16, 4).reshape(2, 8, 3)], axis=1)
        assert_sound(estimate_transport(scene, positions, outgoing, incident, 64, 1))


@pytest.mark.parametrize("roughness", [1e-5, 1e-3])
def test_small_roughness_approaches_the_smooth_boundary(tmp_path: Path, roughness: float) -> None:
    """Unscattered light is a delta function for the smooth boundary and part of Ŝ for the rough one: compare totals."""
    for name in ("smooth", "rough"):
        (tmp_path / name).mkdir()
    smooth = make_scene(tmp_path / "smooth", sphere(3), **HAZE, eta=1.5)
    rough = make_scene(tmp_path / "rough", sphere(3), **HAZE, eta=1.5, roughness=roughness)
    positions, outgoing, normals = queries(smooth.mesh, 16, 3)
    steep = np.sum(outgoing * normals, axis=1) > 0.3
    (one, first), (two, second) = (white_sky(s, positions[steep], outgoing[steep], 4000, 1) for s in (smooth, rough))
    # The loss of single scattering at roughness 1e-3 is below the tolerance of 1e-3.
    assert (np.abs(one - two) < 5.5 * np.hypot(first + 2e-3, second) + 1e-3).all()


CAPS = [(0.7, 0.3), (1.01, 0.3), (1.5, 1.0), (2.5, 0.1), (2.5, 1.0), (4.0, 0.5)]


@pytest.mark.parametrize(("eta", "roughness"), CAPS)
def test_connections_agree_with_exits_at_any_index(tmp_path: Path, eta: float, roughness: float) -> None:
    scene = make_scene(tmp_path, sphere(3), **HAZE, eta=eta, roughness=roughness)
    position = scene.mesh.positions[scene.mesh.faces[100]].mean(axis=0)
    normal = np.asarray(scene.mesh.face_normals)[100]
    outgoing = normal + 0.2 * np.roll(normal, 1)
    outgoing /= np.linalg.norm(outgoing)
    for axis in (normal, -np.cross(normal, np.roll(normal, 1)) / np.linalg.norm(np.cross(normal, np.roll(normal, 1)))):
        assert_agree(*into_cap(scene, position, outgoing, axis, 60.0, paths=400, exits=40_000))


def test_rough_boundary_of_index_near_one_transmits_light(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, sphere(2), **WHITE, eta=1.0 + 1e-10, roughness=0.1)
    positions, outgoing, _ = queries(scene.mesh, 8, 3)
    assert estimate_transport(scene, positions, outgoing, outgoing, 256, 1).mean.min() > 0.0


def _half(x: float = 0.0, z: float = 0.0) -> Mesh:
    """A cube of side ½."""
    return moved(slab(1.0), 0.5, [x, 0.0, z])


def _stays_white(scene: Scene, paths: int = 64) -> None:
    positions, outgoing, _ = queries(scene.mesh, 24, 1)
    assert_furnace(scene, positions, outgoing, paths)


def test_siblings_that_share_faces_conserve_energy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Four cubes around a shared edge, inside another cube."""
    monkeypatch.setattr(prepared, "MOST_EVENTS", 5000)
    inside = tuple(
        {"mesh": moved(slab(1.0), 0.4, [x, 0.0, z]), "name": f"at {x}, {z}", "interface": {"eta": eta}, "medium": WHITE}
        for x, z, eta in ((-0.2, -0.2, 1.1), (0.2, -0.2, 1.2), (-0.2, 0.2, 1.3), (0.2, 0.2, 1.4))
    )
    _stays_white(nested_scene(tmp_path, slab(1.0), WHITE, inside, eta=1.5))


@pytest.mark.parametrize("outside", [1.0, 1.5])
def test_part_that_touches_the_boundary_in_a_point_conserves_energy(tmp_path: Path, outside: float) -> None:
    ball = sphere(2)
    corner = ball.positions[np.argmax(ball.positions[:, 0])]
    inside = {"mesh": moved(ball, 0.5, 0.5 * corner), "name": "bubble", "interface": {"eta": 1.3}, "medium": CLEAR}
    scene = nested_scene(tmp_path, ball, WHITE, (inside,), eta=outside)
    _stays_white(scene)
    # Views straight into the shared point.
    result, _error = white_sky(scene, np.tile(corner, (3, 1)), np.tile(corner, (3, 1)), 64)
    assert (result > 0.8).all()


@pytest.mark.parametrize("outside", [1.0, 1.5])
def test_protruding_part_conserves_energy(tmp_path: Path, outside: float) -> None:
    """The part is clipped at the boundary, where its own index borders on air."""
    inside = {
        "mesh": moved(sphere(2), 0.4, [0.5, 0.05, 0.02]),
        "name": "bump",
        "interface": {"eta": 1.3},
        "medium": WHITE,
    }
    scene = nested_scene(tmp_path, slab(1.0), WHITE, (inside,), eta=outside)
    positions, outgoing, _ = queries(scene.mesh, 40, 1)
    inside_part = np.linalg.norm(positions - [0.5, 0.05, 0.02], axis=1) < 0.38
    assert inside_part.any()
    total, _error = white_sky(scene, positions, outgoing, 64)
    eta = np.where(inside_part, 1.3, outside)
    far = np.abs(np.linalg.norm(positions - [0.5, 0.05, 0.02], axis=1) - 0.39) > 0.03
    from tests.tracer.rough_slab import fresnel

    normals = np.asarray(scene.mesh.face_normals)
    cosine = np.max(np.where(np.abs(positions) > 0.4999, np.abs(outgoing), 0.0), axis=1)
    assert len(normals) == 12
    expected = np.array([1.0 - fresnel(c, 1.0, e) if e != 1.0 else 1.0 for c, e in zip(cosine, eta, strict=True)])
    np.testing.assert_allclose(total[far, 1], expected[far], rtol=1e-5)


@pytest.mark.parametrize("outside", [1.0, 1.5])
def test_part_that_shares_a_face_with_the_boundary_conserves_energy(
    tmp_path: Path, outside: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At the shared face the part's own index borders on air, in a single interface."""
    monkeypatch.setattr(prepared, "MOST_EVENTS", 5000)
    inside = {"mesh": _half(-0.25), "name": "inlay", "interface": {"eta": 1.2}, "medium": WHITE}
    scene = nested_scene(tmp_path, slab(1.0), WHITE, (inside,), eta=outside)
    positions = np.array([[-0.5, 0.03, 0.05], [0.5, 0.03, 0.05], [-0.5, 0.4, 0.4]])
    outgoing = np.array([[-0.8, 0.6, 0.0], [0.8, 0.6, 0.0], [-0.8, 0.6, 0.0]])
    total, _error = white_sky(scene, positions, outgoing, 256)
    from tests.tracer.rough_slab import fresnel

    expected = [1.0 - fresnel(np.float64(0.8), 1.0, eta) if eta != 1.0 else 1.0 for eta in (1.2, outside, outside)]
    np.testing.assert_allclose(total, np.repeat(np.array(expected)[:, None], 3, axis=1), rtol=1e-5)
    # Through a clear inlay the light goes straight, refracted once in and once out.
    clear = nested_scene(tmp_path, slab(1.0), CLEAR, (inside | {"medium": CLEAR},), eta=outside)
    result = estimate_coefficients(clear, positions[:1], outgoing[:1], 0, 64, 1)
    assert result.unscattered[0] > 0.9


THREE_IN_ONE_PLACE = """
import sys
from pathlib import Path
from tests.tracer.nested_scenes import nested_scene
from tests.tracer.scenes import queries, sphere
from prt_bake.tracer.estimate import estimate_coefficients
white = {"sigma_t": 3.0, "albedo": 1.0}
parents = ["object", "0", "1"][: int(sys.argv[2])]
inside = [{"mesh": sphere(2), "name": str(i), "in": parents[i], "medium": white} for i in range(len(parents))]
scene = nested_scene(Path(sys.argv[1]), sphere(2), white, tuple(inside))
positions, outgoing, _ = queries(scene.mesh, 4, 1)
seen = estimate_coefficients(scene, positions, outgoing, 0, 16, 1)
assert abs(12.5664**0.5 * seen.mean[:, 0, 0] + seen.unscattered - 1.0).max() < 1e-4
"""


@pytest.mark.usefixtures("compiled_kernels")
@pytest.mark.parametrize("coincident", [1, 2, 3])
def test_coincident_surfaces_do_not_hang(tmp_path: Path, coincident: int) -> None:
    """The object, a part that fills it, and one that fills that part; in a subprocess with a time limit."""
    command = [sys.executable, "-c", THREE_IN_ONE_PLACE, str(tmp_path), str(coincident)]
    assert subprocess.run(command, timeout=600, cwd=ROOT).returncode == 0


def test_diffuse_part_that_fills_the_object_gives_zero(tmp_path: Path) -> None:
    """Light reflected at x is not counted. Beside a diffuse inlay the furnace still gives 1."""
    body = {"name": "body", "surface": "diffuse", "reflectance": 1.0}
    scene = nested_scene(tmp_path, sphere(2), WHITE, (body | {"mesh": sphere(2)},))
    positions, outgoing, _ = queries(scene.mesh, 12, 3)
    total, _error = white_sky(scene, positions, outgoing, 64)
    np.testing.assert_array_equal(total, 0.0)
    inlay = nested_scene(tmp_path, slab(1.0), WHITE, (body | {"mesh": moved(slab(1.0), 0.5, [-0.25, 0.0, 0.0])},))
    positions, outgoing, _ = queries(inlay.mesh, 40, 3)
    beside = np.abs(positions - [-0.5, 0.0, 0.0]).max(axis=1) > 0.251
    total, _error = white_sky(inlay, positions[beside], outgoing[beside], 64)
    np.testing.assert_allclose(total, 1.0, rtol=1e-5)


def test_furnace_falls_with_roughness(tmp_path: Path) -> None:
    """Single scattering loses energy: the white furnace falls with roughness at every index, but not to zero."""
    for eta in (0.7, 1.3, 2.5):
        totals = []
        for roughness in (1e-3, 0.3, 1.0):
            folder = tmp_path / f"{eta} {roughness}"
            folder.mkdir()
            scene = make_scene(folder, sphere(2), **WHITE, eta=eta, roughness=roughness)
            normals = np.asarray(scene.mesh.face_normals)[:16]
            middles = scene.mesh.positions[scene.mesh.faces[:16]].mean(axis=1)
            result = estimate_coefficients(scene, middles, normals, 0, 1024, 1)
            totals.append(float(SQRT_4_PI * result.mean[:, 0].mean()))
        assert totals[0] > totals[1] > totals[2] > 0.005
