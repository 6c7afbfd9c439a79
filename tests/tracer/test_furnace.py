"""White furnaces: without absorption a constant sky gives a known radiance, whatever is inside.

∫ Ŝ dωi is 1 − T behind an index-matched boundary and 1 − F − U behind a smooth one, T and U being unscattered.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from formats.mesh import Mesh
from formats.scene import Scene
from prt_bake import estimate_coefficients, estimate_transport
from tests.mathematics.significance import assert_agree, largest_z, z_scores
from tests.tracer.optical_depth import optical_depth
from tests.tracer.scenes import blotches, lumpy, make_scene, queries, sphere, unit_directions

SHAPES = {"convex": sphere, "hollows": lumpy}
MEDIA: dict[str, dict[str, Any]] = {
    "homogeneous": {"sigma_t": 3.0},
    "contrast": {"sigma_t": 20.0 * blotches((6, 5, 7), 1e3, 5)},
}
MATCHED: dict[str, Any] = {"eta": 1.0}
SMOOTH: dict[str, Any] = {"eta": 1.35}
ROOT = np.sqrt(4.0 * np.pi)


def white(folder: Path, shape: str, medium: str, **given: Any) -> tuple[Scene, Mesh]:
    scene = make_scene(folder, SHAPES[shape](2), albedo=1.0, **MEDIA[medium], **given)
    return scene, scene.mesh


def straight_through(scene: Scene, positions: np.ndarray, outgoing: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """T [N] along −ωo, by testing every face."""
    rows = zip(positions - 1e-9 * normals, -outgoing, strict=True)
    return np.exp([-optical_depth(scene, x[None], d)[0] for x, d in rows])


def reflected(cosine: np.ndarray, eta: float) -> np.ndarray:
    """Fresnel reflectance from amplitudes."""
    across = np.sqrt(1.0 - (1.0 - cosine**2) / eta**2)
    return 0.5 * (
        ((cosine - eta * across) / (cosine + eta * across)) ** 2
        + ((eta * cosine - across) / (eta * cosine + across)) ** 2
    )


@pytest.mark.parametrize("phase_g", [0.0, 0.9])
@pytest.mark.parametrize("medium", MEDIA)
@pytest.mark.parametrize("shape", SHAPES)
def test_matched_furnace(tmp_path: Path, shape: str, medium: str, phase_g: float) -> None:
    """Every walk exits with throughput 1; the unscattered share is the transmittance of the straight line."""
    scene, mesh = white(tmp_path, shape, medium, phase_g=phase_g, **MATCHED)
    positions, outgoing, normals = queries(mesh, 40, 3)
    result = estimate_coefficients(scene, positions, outgoing, 0, 1024, 1)
    total = ROOT * result.mean[:, 0, :] + result.unscattered[:, None]
    np.testing.assert_allclose(total, 1.0, rtol=1e-12)
    np.testing.assert_array_equal(result.lost, 0.0)
    straight = straight_through(scene, positions, outgoing, normals)
    error = np.sqrt(straight * (1.0 - straight) / result.paths)
    assert_agree(result.unscattered, error, straight)
    assert_agree(ROOT * result.mean[:, 0, 1], error, 1.0 - straight)
    ratio = result.standard_error[:, 0, 1] * ROOT / error
    assert (np.abs(ratio[straight > 0.1] - 1.0) < 0.25).all()


@pytest.mark.parametrize("phase_g", [0.0, 0.9])
@pytest.mark.parametrize("medium", MEDIA)
@pytest.mark.parametrize("shape", SHAPES)
def test_smooth_furnace(tmp_path: Path, shape: str, medium: str, phase_g: float) -> None:
    """All but the reflection at x returns, scattered or not (float32 positions: 1e-5 at grazing views)."""
    scene, mesh = white(tmp_path, shape, medium, phase_g=phase_g, **SMOOTH)
    positions, outgoing, normals = queries(mesh, 40, 4)
    result = estimate_coefficients(scene, positions, outgoing, 0, 512, 1)
    expected = 1.0 - reflected(np.sum(outgoing * normals, axis=1), scene.eta)
    np.testing.assert_allclose(
        ROOT * result.mean[:, 0, :] + result.unscattered[:, None], expected[:, None].repeat(3, 1), rtol=1e-5
    )
    np.testing.assert_array_equal(result.lost, 0.0)


def test_smooth_boundary_of_index_near_one_is_index_matched(tmp_path: Path) -> None:
    (tmp_path / "smooth").mkdir()
    scene, mesh = white(tmp_path, "hollows", "homogeneous")
    smooth, _ = white(tmp_path / "smooth", "hollows", "homogeneous", eta=1.0 + 1e-6)
    positions, outgoing, _ = queries(mesh, 40, 5)
    result, other = (estimate_coefficients(s, positions, outgoing, 2, 2048, n) for n, s in enumerate((scene, smooth)))
    assert_agree(result.mean, result.standard_error, other.mean, other.standard_error)
    error = np.sqrt(result.unscattered * (1.0 - result.unscattered) / result.paths)
    assert_agree(result.unscattered, error, other.unscattered, error)


@pytest.mark.parametrize("phase_g", [0.0, 0.9])
@pytest.mark.parametrize("medium", MEDIA)
@pytest.mark.parametrize("shape", SHAPES)
def test_matched_furnace_by_transport(tmp_path: Path, shape: str, medium: str, phase_g: float) -> None:
    """Ŝ summed over random directions of incidence."""
    scene, mesh = white(tmp_path, shape, medium, phase_g=phase_g, **MATCHED)
    positions, outgoing, normals = queries(mesh, 4, 6)
    copies, paths, directions = 256, 16, 32
    incident = unit_directions(4 * copies * directions, 7).reshape(-1, directions, 3)
    result = estimate_transport(
        scene, np.repeat(positions, copies, 0), np.repeat(outgoing, copies, 0), incident, paths, 2
    )
    sums = 4.0 * np.pi * result.mean.mean(axis=1)[:, 1].reshape(4, copies)
    straight = straight_through(scene, positions, outgoing, normals)
    assert_agree(sums.mean(axis=1), sums.std(axis=1, ddof=1) / np.sqrt(copies), 1.0 - straight)
    unscattered = result.unscattered.reshape(4, copies)
    if medium == "homogeneous":
        np.testing.assert_allclose(unscattered, straight[:, None].repeat(copies, 1), rtol=2e-5)
    else:
        binomial = np.sqrt(straight * (1.0 - straight) / (copies * paths))
        assert_agree(unscattered.mean(axis=1), binomial, straight)


@pytest.mark.parametrize("shape", SHAPES)
def test_rough_furnace_never_gains_energy(tmp_path: Path, shape: str) -> None:
    """Single scattering loses energy at every event: below the smooth furnace, and close to it at small alpha."""
    found = []
    for roughness in (1e-3, 0.1, 0.5):
        (tmp_path / f"{roughness}").mkdir()
        scene, mesh = white(tmp_path / f"{roughness}", shape, "homogeneous", eta=1.35, roughness=roughness)
        positions, outgoing, normals = queries(mesh, 30, 8)
        facing = np.sum(outgoing * normals, axis=1) > 0.3
        result = estimate_coefficients(scene, positions[facing], outgoing[facing], 0, 1024, 1)
        share = ROOT * result.mean[:, 0, 0] / (1.0 - reflected(np.sum(outgoing * normals, axis=1)[facing], scene.eta))
        error = ROOT * result.standard_error[:, 0, 0] / share
        assert (z_scores(share, error, 1.0) < largest_z(len(share))).all()
        found.append(float(share.mean()))
    assert found[0] > 0.995
    assert found[0] > found[1] > found[2] > 0.4
