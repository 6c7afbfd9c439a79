"""Path-traced bakes agree with estimates of the same scene, with calibrated errors, for any block size."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bakers.transport import prepared
from formats.asset import Asset
from formats.errors import InputWarning, QueryError
from formats.mesh import Mesh, build_mesh, flipped
from formats.scene import Scene
from prt_bake.baking.bake import bake, plan
from prt_bake.baking.path_traced import PathTraced
from prt_bake.mathematics.sphere import to_world
from prt_bake.tracer.estimate import Estimate, estimate_coefficients
from tests.mathematics.significance import assert_agree
from tests.tracer.nested_scenes import CLEAR, nested_scene
from tests.tracer.scenes import make_scene, moved, slab, sphere

FINE, COARSE = sphere(2), sphere(0)
"""The object, and twelve of its vertices as a mesh; at a sharp corner a grazing ray would carry almost nothing."""
MILK: dict[str, Any] = {"sigma_t": [1.0, 2.0, 4.0], "albedo": [0.95, 0.9, 0.6], "phase_g": 0.4}
RINGS, SECTORS, WALKS, MORE = 2, 3, 512, 8


def matched(folder: Path) -> Scene:
    return make_scene(folder, FINE, **MILK)


def rough(folder: Path) -> Scene:
    return make_scene(folder, FINE, **MILK, eta=1.4, roughness=0.3)


def smooth(folder: Path) -> Scene:
    return make_scene(folder, FINE, **MILK, eta=1.4)


def nested(folder: Path) -> Scene:
    """Milk and a stone in smooth glass; every ray that enters hits the milk."""
    milk = {"name": "milk", "mesh": moved(sphere(1), 0.8), "medium": MILK, "interface": {"eta": 1.3}}
    stone = {"name": "stone", "mesh": moved(sphere(0), 0.2), "in": "milk", "surface": "diffuse", "reflectance": 0.7}
    return nested_scene(folder, FINE, CLEAR, (milk, stone), eta=1.5)


def baked(scene: Scene, mesh: Mesh = COARSE, degree: int = 2, **settings: Any) -> Asset:
    settings = {"rings": RINGS, "sectors": SECTORS, "samples": WALKS} | settings
    return bake(PathTraced(scene), mesh, degree, **settings)


def test_walks_on_a_gpu_are_prepared_for_it(tmp_path: Path) -> None:
    traced = PathTraced(matched(tmp_path), "cuda")
    assert prepared(traced, "float32", "cuda") is traced
    traced.device = "cpu"
    with pytest.raises(QueryError, match="only be baked with precision float32 on the cpu, found float32 on cuda"):
        prepared(traced, "float32", "cuda")


def estimated(scene: Scene, asset: Asset, degree: int) -> Estimate:
    """The same coefficients [V·B,K,3] from the estimate alone, with `MORE` times the walks."""
    mesh = asset.mesh
    eye = to_world(asset.directions, mesh.normals[:, None], asset.tangents[:, None]).reshape(-1, 3)
    positions = np.repeat(mesh.positions, RINGS * SECTORS, axis=0)
    return estimate_coefficients(scene, positions, eye, degree, MORE * WALKS, seed=77)


@pytest.mark.statistics
@pytest.mark.parametrize("degree", [0, 2, 5])
@pytest.mark.parametrize("make", [matched, rough, smooth, nested])
def test_a_bake_agrees_with_independent_estimates(make: Any, degree: int, tmp_path: Path) -> None:
    """A z-test of every coefficient, at 1e-4 for all of a bake together. The stated errors agree within four standard
    deviations of an rms over 72 bins, each with one independent number or, beyond degree 0, four.
    """
    scene = make(tmp_path)
    asset, truth = baked(scene, degree=degree, seed=3), estimated(scene, baked(scene, degree=0, samples=2), degree)
    found = asset.coefficients.reshape(truth.mean.shape)
    assert_agree(found, truth.standard_error * np.sqrt(MORE), truth.mean, truth.standard_error)
    scatter = 4.0 / np.sqrt(2 * 72 * (1 if degree == 0 else 4))
    stated = (asset.standard_error**2).mean() + (truth.standard_error**2).mean()
    assert np.sqrt(((found - truth.mean) ** 2).mean() / stated) == pytest.approx(1.0, abs=scatter)
    assert asset.provenance["error_estimate"] == "independent walks"
    assert asset.provenance["evaluations"] == 12 * RINGS * SECTORS * WALKS == asset.error_vs_time[-1, 1]
    assert asset.provenance["walks"]["unscattered"] == pytest.approx(truth.unscattered.mean(), abs=0.01)


@pytest.mark.parametrize("interface", [{}, {"eta": 1.4}], ids=["matched", "smooth"])
def test_white_furnace(interface: dict[str, float], tmp_path: Path) -> None:
    """Without absorption and under white light, scattered and unscattered radiance add up to what enters the object: 1
    if it is index-matched, and 1 less the reflectance behind a smooth boundary.
    """
    scene = make_scene(tmp_path, FINE, sigma_t=2.0, albedo=1.0, **interface)
    asset = baked(scene, degree=0)
    white = asset.coefficients.mean() * np.sqrt(4 * np.pi)
    entered = white + asset.provenance["walks"]["unscattered"]
    if not interface:
        assert entered == pytest.approx(1.0, abs=1e-5)
    noise = np.sqrt(4 * np.pi * (asset.standard_error**2).mean() / asset.standard_error.size)
    assert entered < 1.0 + 5 * noise
    assert entered > 0.8
    assert asset.provenance["walks"]["lost"] == 0.0


def test_results_do_not_depend_on_workers_or_block_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = rough(tmp_path)
    whole = baked(scene, samples=64, seed=5)
    others = [baked(scene, samples=64, seed=5, workers=3)]
    monkeypatch.setattr("bakers.path_traced.WALKS_AT_ONCE", 5 * RINGS * SECTORS * 64)
    others.append(baked(scene, samples=64, seed=5))
    for other in others:
        np.testing.assert_array_equal(other.coefficients, whole.coefficients)
        np.testing.assert_array_equal(other.standard_error, whole.standard_error)
        assert other.provenance["walks"] == pytest.approx(whole.provenance["walks"])
    assert (baked(scene, samples=64, seed=6).coefficients != whole.coefficients).mean() > 0.9
    # Vertices and bins have independent walks: no two rows of errors are equal.
    errors = (whole.coefficients - whole.coefficients.mean(axis=(0, 1))).reshape(-1, 27)
    assert len(np.unique(errors, axis=0)) == len(errors)


def test_a_mesh_slightly_off_the_surface_is_accepted_and_one_farther_off_raises(tmp_path: Path) -> None:
    scene = matched(tmp_path)
    reach = 1e-4 * scene.mesh.diagonal
    near = build_mesh(COARSE.positions + 0.5 * reach * COARSE.normals, COARSE.faces)
    truth = estimated(scene, baked(scene, degree=0, samples=2), 1)
    found = baked(scene, near, degree=1).coefficients.reshape(truth.mean.shape)
    assert_agree(found, truth.standard_error * np.sqrt(MORE), truth.mean, truth.standard_error)
    far = build_mesh(COARSE.positions + 10.0 * reach * COARSE.normals, COARSE.faces)
    sentence = rf"12 of 12 vertices do not lie on the surface of .*scene\.toml; .* {10 * reach:.3g} away"
    for command in (baked, lambda scene, mesh: plan(PathTraced(scene), mesh, 2, RINGS, SECTORS)):
        with pytest.raises(QueryError, match=sentence):
            command(scene, far)
        with pytest.raises(QueryError, match="12 of 12 vertices point into the object"):
            command(scene, flipped(COARSE))


def test_a_shell_that_is_wound_inside_out_is_warned_about(tmp_path: Path) -> None:
    ball, small = FINE, moved(sphere(0), 0.3, [3.0, 0.0, 0.0])
    positions = np.concatenate([ball.positions, small.positions])
    faces = np.concatenate([ball.faces, small.faces + len(ball.positions)])
    scene = make_scene(tmp_path, build_mesh(positions, faces), **MILK)
    faces[len(ball.faces) :] = faces[len(ball.faces) :, ::-1]
    with pytest.warns(
        InputWarning, match=r"normals of 12 of 174 vertices point into .*scene\.toml, the first at .*; make"
    ):
        PathTraced(scene).refuse_foreign(build_mesh(positions, faces))


def test_views_of_other_faces_are_clamped_to_the_horizon_of_the_scene(tmp_path: Path) -> None:
    """A tetrahedron with a corner on each of four sides of a box; its normals differ from those of the box."""
    scene = make_scene(tmp_path, slab(1.0), sigma_t=2.0, albedo=0.9)
    corners = np.array([[0.5, 0.1, 0.0], [-0.3, 0.5, 0.1], [0.0, -0.5, 0.2], [0.2, 0.1, -0.5]])
    asset = baked(scene, build_mesh(corners, np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])), samples=8)
    assert asset.valid.all()
    assert 0 < asset.provenance["bins_moved_to_the_horizon"] < 4 * RINGS * SECTORS


def test_the_number_of_walks_for_an_error_is_predicted_from_one_pilot(tmp_path: Path) -> None:
    scene = matched(tmp_path)
    asset = baked(scene, degree=1, samples=64, error=0.05, seed=2)
    truth = estimated(scene, asset, 1)
    reached = np.sqrt(((asset.coefficients.reshape(truth.mean.shape) - truth.mean) ** 2).sum() / (truth.mean**2).sum())
    assert 0.035 < asset.error_vs_time[-1, 2] <= 0.05
    assert reached < 0.065
    with pytest.raises(QueryError, match="paths a bin leave"):
        baked(scene, degree=1, samples=64, error=1e-4)
