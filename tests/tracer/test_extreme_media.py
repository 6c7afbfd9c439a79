"""Media at their limits: thick, white, sharp, heterogeneous, chromatic. No NaN, no lost energy, no endless walk.

z-tests of false-alarm rate `significance.FALSE_ALARM` each, about 25 of them.
"""

import math
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from formats.scene import Scene
from prt_bake.tracer import prepared
from prt_bake.tracer.estimate import estimate_coefficients, estimate_transport
from prt_bake.tracer.volume.majorants import extinction_blocks, steep_extinction
from prt_bake.tracer.volume.media import phase
from tests.mathematics.significance import assert_agree
from tests.tracer import half_space
from tests.tracer.scenes import lumpy, make_scene, moved, queries, slab, sphere, unit_directions
from tests.tracer.soundness import SQRT_4_PI, assert_furnace, assert_sound, into_cap, white_sky

pytestmark = pytest.mark.statistics

MATCHED: dict[str, Any] = {}
SMOOTH: dict[str, Any] = {"eta": 1.4}
ROUGH: dict[str, Any] = {"eta": 1.4, "roughness": 0.3}


@pytest.mark.parametrize("size", [0.3, 0.99, 1.0 - 1e-6, 1.0 - 1e-9, 1.0 - 1e-15])
def test_the_phase_function_is_accurate_up_to_its_limits(size: float) -> None:
    """Compared with exact fractions; s = 1 − cosθ from the peak."""
    whole = Fraction(size)
    for g in (size, -size):
        for cosine in (1.0, 1.0 - 1e-12, 0.999, 0.0, -1.0):
            squared = 1 + whole * whole - 2 * whole * Fraction(cosine)
            expected = float(1 - whole * whole) / (4.0 * math.pi) / float(squared) ** 1.5
            assert phase(math.copysign(1.0, g) * cosine, g) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("interface", [MATCHED, SMOOTH])
@pytest.mark.parametrize("sigma_t", [1e-9, 1e-3, 100.0, 1e4])
def test_white_furnace_holds_for_any_thickness(tmp_path: Path, sigma_t: float, interface: dict[str, Any]) -> None:
    scene = make_scene(tmp_path, moved(sphere(3), 0.5), sigma_t=sigma_t, albedo=1.0, **interface)
    assert_furnace(scene, *queries(scene.mesh, 12, 3)[:2], paths=48)


@pytest.mark.parametrize("albedo", [0.9999, 1.0])
def test_ten_thousand_mean_free_paths_reflect_like_a_half_space(tmp_path: Path, albedo: float) -> None:
    """Ŝ by Chandrasekhar's H function, including grazing directions; the transmitted share is at most 1e-4."""
    scene = make_scene(tmp_path, slab(1.0), sigma_t=1e4, albedo=albedo)
    cosine = np.array([1.0, 0.9, 0.6, 0.3, 0.1, 0.02])
    outgoing = _at_cosines(cosine, 0.0)
    incident = _at_cosines(np.roll(cosine, 2), 2.0)
    top = np.tile([0.05, 0.02, 0.5], (len(cosine), 1))
    result = estimate_transport(scene, top, outgoing, incident, 256, 1)
    assert_sound(result)
    expected = half_space.reflected(albedo, outgoing[:, 2], incident[:, 2])
    assert_agree(result.mean[:, 1], result.standard_error[:, 1], expected)
    assert np.median(result.standard_error[:, 1] / expected) < 0.2


@pytest.mark.parametrize("albedo", [0.0, 0.5, 0.99, 0.9999])
def test_white_sky_over_ten_thousand_mean_free_paths(tmp_path: Path, albedo: float) -> None:
    scene = make_scene(tmp_path, slab(1.0), sigma_t=1e4, albedo=albedo)
    outgoing = _at_cosines(np.array([1.0, 0.7, 0.3, 0.05]), 1.0)
    total, error = white_sky(scene, np.tile([0.05, 0.02, 0.5], (4, 1)), outgoing, 512)
    assert_agree(total[:, 1], error[:, 1], half_space.white_sky(albedo, outgoing[:, 2]))


def _at_cosines(cosine: np.ndarray, turn: float) -> np.ndarray:
    sine = np.sqrt(1.0 - cosine**2)
    return np.stack([sine * np.cos(turn), sine * np.sin(turn), cosine], axis=1)


def test_truncated_walks_are_reported_as_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Returned and lost energy sum to 1, for exits; connections report the same loss."""
    monkeypatch.setattr(prepared, "MOST_EVENTS", 50)
    scene = make_scene(tmp_path, moved(sphere(3), 0.5), sigma_t=500.0, albedo=1.0)
    positions, outgoing, _ = queries(scene.mesh, 6, 3)
    result = estimate_coefficients(scene, positions, outgoing, 0, 512, 1)
    assert result.lost.min() > 0.05
    np.testing.assert_allclose(SQRT_4_PI * result.mean[:, 0, 0] + result.unscattered + result.lost, 1.0, rtol=1e-12)
    connected = estimate_transport(scene, positions, outgoing, unit_directions(6, 1), 512, 1)
    assert (np.abs(connected.lost - result.lost) < 0.15).all()


@pytest.mark.parametrize("interface", [MATCHED, SMOOTH])
@pytest.mark.parametrize("phase_g", [-0.9999, -0.99, 0.99, 0.9999])
def test_sharp_phase_functions_conserve_energy(tmp_path: Path, phase_g: float, interface: dict[str, Any]) -> None:
    scene = make_scene(tmp_path, lumpy(2), sigma_t=20.0, albedo=1.0, phase_g=phase_g, **interface)
    positions, outgoing, _ = queries(scene.mesh, 12, 4)
    assert_furnace(scene, positions, outgoing, paths=256)
    if not interface:
        # Forward, backward and axis directions, at and away from the peak.
        incident = np.stack([-outgoing, outgoing, *np.broadcast_to(np.eye(3)[:, None], (3, *outgoing.shape))], axis=1)
        assert_sound(estimate_transport(scene, positions, outgoing, incident, 128, 1))


@pytest.mark.parametrize("phase_g", [-0.99, 0.99])
def test_connections_to_a_sharp_phase_function_agree_with_exits(tmp_path: Path, phase_g: float) -> None:
    scene = make_scene(tmp_path, sphere(3), sigma_t=1.5, albedo=0.9, phase_g=phase_g)
    outgoing = np.array([0.0, 0.6, 0.8])
    position = np.array([0.02, 0.03, 1.0])
    position *= 0.9995 / np.linalg.norm(position)
    sideways = np.array([1.0, 0.0, 0.0])
    for axis, degrees in ((-outgoing, 12.0), (outgoing, 12.0), (sideways, 40.0)):
        mean, error, expected, due_error = into_cap(
            scene, _on_surface(scene, position), outgoing, axis, degrees, paths=2000, exits=100_000
        )
        straight = estimate_transport(scene, _on_surface(scene, position)[None], outgoing[None], sideways[None], 2)
        # Exits include unscattered light, connections do not.
        expected = expected - straight.unscattered[0] * (axis @ -outgoing > 0.99)
        assert_agree(mean, error, expected, due_error)


def _on_surface(scene: Scene, near: np.ndarray) -> np.ndarray:
    """The nearest face centre."""
    middles = scene.mesh.positions[scene.mesh.faces].mean(axis=1)
    return np.asarray(middles[np.argmin(np.linalg.norm(middles - near, axis=1))])


@pytest.mark.parametrize("interface", [MATCHED, ROUGH])
def test_rare_dense_cells_do_not_determine_the_cost(tmp_path: Path, interface: dict[str, Any]) -> None:
    """1e4 : 1 in five of 32,768 cells: one majorant for the whole grid would take some thousand steps per flight."""
    rare = np.ones((32, 32, 32))
    rare[[4, 9, 16, 20, 28], [16, 20, 15, 9, 16], [16, 9, 15, 22, 17]] = 1e4
    majorants = extinction_blocks(rare, np.ones(3))[0][:, 1]
    tracked_by_cells = majorants > steep_extinction(rare.shape, np.ones(3))
    assert tracked_by_cells.mean() < 0.05
    assert majorants[~tracked_by_cells].max() == 1.0
    scene = make_scene(tmp_path, sphere(3), sigma_t=rare, albedo=0.5, **interface)
    positions, outgoing, _ = queries(scene.mesh, 16, 3)
    assert_sound(estimate_transport(scene, positions, outgoing, unit_directions(16, 5), 1024, 1))


@pytest.mark.parametrize("interface", [MATCHED, SMOOTH])
@pytest.mark.parametrize("contrast", [1e4, np.inf])
def test_heterogeneous_white_furnace(tmp_path: Path, contrast: float, interface: dict[str, Any]) -> None:
    """Cells ten thousand times as dense as others, and empty ones."""
    dense = np.random.default_rng(3).random((12, 9, 10)) < 0.05
    scene = make_scene(tmp_path, lumpy(2), sigma_t=np.where(dense, 200.0, 200.0 / contrast), albedo=1.0, **interface)
    assert_furnace(scene, *queries(scene.mesh, 12, 3)[:2], paths=128)


@pytest.mark.parametrize("shape", [(1, 1, 1), (5, 4, 6)])
def test_grid_of_zeros_is_a_vacuum(tmp_path: Path, shape: tuple[int, int, int]) -> None:
    scene = make_scene(tmp_path, lumpy(2), sigma_t=np.zeros(shape), albedo=0.5)
    positions, outgoing, _ = queries(scene.mesh, 8, 3)
    for result in (
        estimate_coefficients(scene, positions, outgoing, 1, 64, 1),
        estimate_transport(scene, positions, outgoing, -outgoing, 64, 1),
    ):
        assert_sound(result)
        np.testing.assert_array_equal(result.mean, 0.0)
        np.testing.assert_array_equal(result.unscattered, 1.0)


@pytest.mark.parametrize("bounds", [None, [[-0.1] * 3, [0.1] * 3], [[-1e3] * 3, [1e3] * 3], [[7.0] * 3, [8.0] * 3]])
def test_single_cell_is_a_constant_for_any_box(tmp_path: Path, bounds: Any) -> None:
    (tmp_path / "plain").mkdir()
    plain = make_scene(tmp_path / "plain", lumpy(2), sigma_t=3.0, albedo=0.8)
    grid = make_scene(
        tmp_path, lumpy(2), sigma_t=np.full((1, 1, 1), 3.0), albedo=np.full((1, 1, 1, 3), 0.8), bounds=bounds
    )
    _assert_alike(plain, grid)


def test_grid_is_clamped_outside_its_box(tmp_path: Path) -> None:
    """The object is entirely below the box, so that the lowest cell fills it."""
    values = np.random.default_rng(4).uniform(0.0, 9.0, (3, 4, 5))
    (tmp_path / "plain").mkdir()
    plain = make_scene(tmp_path / "plain", lumpy(2), sigma_t=values[0, 0, 0], albedo=0.8)
    _assert_alike(plain, make_scene(tmp_path, lumpy(2), sigma_t=values, albedo=0.8, bounds=[[5.0] * 3, [6.0] * 3]))


def _assert_alike(one: Scene, two: Scene) -> None:
    positions, outgoing, _ = queries(one.mesh, 12, 3)
    arguments = (positions, outgoing, unit_directions(12, 4), 4000)
    a, b = (estimate_transport(scene, *arguments, seed=n) for n, scene in enumerate((one, two)))
    assert_sound(b)
    assert_agree(a.mean, a.standard_error, b.mean, b.standard_error)
    a, b = (estimate_coefficients(scene, positions, outgoing, 0, 4000, n) for n, scene in enumerate((one, two)))
    assert_agree(a.mean, a.standard_error, b.mean, b.standard_error)


def test_grid_of_256_cells_per_axis(tmp_path: Path) -> None:
    """Look-ups in a large grid are correct (`tests/bench/extremes.py` measures its preparation)."""
    generator = np.random.default_rng(6)
    grid = generator.uniform(1.0, 7.0, (256, 256, 256)).astype(np.float32)
    grid[generator.integers(0, 256, 500), 128, 128] = 1e4
    scene = make_scene(tmp_path, lumpy(2), sigma_t=grid, albedo=1.0)
    medium = prepared.prepare(scene).medium
    assert medium.extinction_cells.nbytes == grid.nbytes
    assert_furnace(scene, *queries(scene.mesh, 8, 3)[:2], paths=64)


def test_albedo_of_zero_absorbs_all_light(tmp_path: Path) -> None:
    """With albedo 0 everywhere only unscattered light is left; with albedo 0 in some cells there is less and no NaN."""
    (tmp_path / "black").mkdir()
    black = make_scene(tmp_path / "black", lumpy(2), sigma_t=2.0, albedo=np.zeros((2, 3, 2, 3)))
    positions, outgoing, _ = queries(black.mesh, 12, 3)
    assert estimate_transport(black, positions, outgoing, -outgoing, 64, 1).mean.max() == 0.0
    assert estimate_coefficients(black, positions, outgoing, 1, 64, 1).mean.max() == 0.0
    albedo = np.random.default_rng(3).choice([0.0, 1.0], (4, 4, 4, 3))
    spotted = make_scene(tmp_path, lumpy(2), sigma_t=8.0, albedo=albedo)
    total, _error = white_sky(spotted, positions, outgoing, 512)
    assert 0.05 < total.mean() < 0.95
    assert total.max() <= 1.0 + 1e-12
    assert_sound(estimate_transport(spotted, positions, outgoing, outgoing, 256, 1))


CHANNELS = [[0.1, 3.0, 100.0], [0.0, 1.0, 100.0], [0.0, 0.0, 5.0], [5.0, 0.0, 0.0]]


@pytest.mark.parametrize("interface", [MATCHED, SMOOTH])
@pytest.mark.parametrize("sigma_t", CHANNELS)
def test_very_different_channels_conserve_energy(
    tmp_path: Path, sigma_t: list[float], interface: dict[str, Any]
) -> None:
    """The sum of the three channels is exact."""
    scene = make_scene(tmp_path, lumpy(2), sigma_t=sigma_t, albedo=1.0, **interface)
    positions, outgoing, normals = queries(scene.mesh, 12, 3)
    inside = np.sum(outgoing * normals, axis=1) > 0.2
    positions, outgoing = positions[inside], outgoing[inside]
    result = estimate_coefficients(scene, positions, outgoing, 0, 1024, 1)
    assert_sound(result)
    total = SQRT_4_PI * result.mean[:, 0] + result.unscattered.reshape(len(positions), -1)
    (tmp_path / "plain").mkdir()
    plain = make_scene(tmp_path / "plain", lumpy(2), sigma_t=1.0, albedo=1.0, **interface)
    expected, _ = white_sky(plain, positions, outgoing, 16)
    np.testing.assert_allclose(total.sum(axis=1), expected.sum(axis=1), rtol=1e-5)
    np.testing.assert_array_equal(result.mean[..., np.array(sigma_t) == 0.0], 0.0)


@pytest.mark.parametrize("interface", [MATCHED, ROUGH])
def test_very_different_channels_agree_with_single_ones(tmp_path: Path, interface: dict[str, Any]) -> None:
    sigma_t = [0.05, 2.0, 50.0]
    together = make_scene(tmp_path, sphere(3), sigma_t=sigma_t, albedo=0.9, **interface)
    positions, outgoing, _ = queries(together.mesh, 8, 3)
    incident = unit_directions(8, 6)
    result = estimate_transport(together, positions, outgoing, incident, 6000, 1)
    assert_sound(result)
    for c, value in enumerate(sigma_t):
        (tmp_path / str(c)).mkdir()
        alone = make_scene(tmp_path / str(c), sphere(3), sigma_t=value, albedo=0.9, **interface)
        one = estimate_transport(alone, positions, outgoing, incident, 6000, 2)
        assert_agree(result.mean[:, c], result.standard_error[:, c], one.mean[:, c], one.standard_error[:, c])
