"""Both estimators compared with deterministic integrals that share no code with the product.

z-tests at `significance.FALSE_ALARM` for all values of a test; the errors of the integrals are stated where they
matter.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from formats.scene import Scene
from prt_bake import estimate_coefficients, estimate_transport
from prt_bake.mathematics import sh
from tests.mathematics.significance import assert_agree
from tests.tracer.optical_depth import at_cells, single_scattering
from tests.tracer.rough_slab import black_slab
from tests.tracer.scenes import lumpy, make_scene, queries, slab, sphere, unit_directions

pytestmark = pytest.mark.statistics

SIGMA_T = np.random.default_rng(7).uniform(0.3, 5.0, (4, 5, 6))
SINGLE: dict[str, tuple[Any, dict[str, Any]]] = {
    "sphere": (sphere, {"sigma_t": 2.0, "phase_g": 0.4}),
    "thick sphere, forward": (sphere, {"sigma_t": 12.0, "phase_g": 0.85}),
    "hollows, backward": (lumpy, {"sigma_t": 3.0, "phase_g": -0.5}),
    "hollows, grid": (lumpy, {"sigma_t": SIGMA_T, "phase_g": 0.0}),
}


@pytest.mark.parametrize("kind", SINGLE)
def test_single_scattering(kind: str, tmp_path: Path) -> None:
    """Ŝ / ε at an albedo of ε = 1e-5: single scattering along the view, through all crossings."""
    shape, medium = SINGLE[kind]
    epsilon, copies = 1e-5, 4
    scene = make_scene(tmp_path, shape(2), albedo=epsilon, **medium)
    positions, outgoing, _ = (np.repeat(rows, copies, axis=0) for rows in queries(scene.mesh, 10, seed=1))
    incident = unit_directions(len(positions), seed=2)
    ours = estimate_transport(scene, positions, outgoing, incident, 10_000, 3)
    kept = np.flatnonzero(ours.reliable)
    assert len(kept) >= 15
    exact = np.array([single_scattering(scene, positions[n], outgoing[n], incident[n], steps=800) for n in kept])
    # 800 midpoints err by 1e-3 at shadow edges on the view ray.
    assert_agree(ours.mean[kept, 0] / epsilon, ours.standard_error[kept, 0] / epsilon, exact, 1e-3 * exact)


def test_single_scattering_uses_the_local_albedo(tmp_path: Path) -> None:
    """Faces of many mean free paths: a half space under normal light, ∫ σ exp(−σ t (1 + cosθo)) dt / 4π."""
    albedo = np.full((1, 1, 4, 3), 1e-6) * np.array([1.0, 2.0, 5.0, 9.0])[:, None]
    scene = make_scene(tmp_path, sphere(1), sigma_t=2000.0, albedo=albedo, phase_g=0.0)
    positions, outgoing, normals = queries(scene.mesh, 40, seed=1)
    ours = estimate_transport(scene, positions, outgoing, normals, 4_000, 3)
    here = at_cells(albedo[..., 1], scene.bounds, positions)
    exact = here / (4.0 * np.pi * (1.0 + np.sum(outgoing * normals, axis=1)))
    # Over a mean free path the albedo changes by at most 0.3 %.
    assert_agree(ours.mean[:, 1], ours.standard_error[:, 1], exact, 3e-3 * exact)


ABSORBING: dict[str, Any] = {"depth": 1.2, "alpha": 0.5, "eta": 1.4}
VIEW = np.array([0.48, 0.36, 0.8])
MIDDLE = np.array([0.3, 0.1, 0.5])


def absorbing_slab(folder: Path) -> Scene:
    interface = {"eta": ABSORBING["eta"], "roughness": ABSORBING["alpha"]}
    return make_scene(folder, slab(40.0), sigma_t=ABSORBING["depth"], albedo=0.0, **interface)


def test_black_medium_behind_a_rough_interface(tmp_path: Path) -> None:
    """Albedo 0: light passes two rough interfaces, with internal reflections in between."""
    scene = absorbing_slab(tmp_path)
    incident = np.array([[-0.3, -0.2, -0.9], [0.3, 0.1, -0.95], [-0.6, -0.3, -0.5], [0.0, 0.0, -1.0]])
    incident /= np.linalg.norm(incident, axis=1, keepdims=True)
    copies = 8
    result = estimate_transport(
        scene,
        np.tile(MIDDLE, (copies, 1)),
        np.tile(VIEW, (copies, 1)),
        np.tile(incident, (copies, 1, 1)),
        30_000,
        1,
        connections=1,
    )
    mean = result.mean[..., 0].mean(axis=0)
    error = np.sqrt(np.sum(result.standard_error[..., 0] ** 2, axis=0)) / copies
    exact = black_slab(VIEW, incident, **ABSORBING, nodes=40, orders=3)
    # 40 × 80 directions err by 1e-3. Behind a rough interface nothing counts as unscattered.
    assert_agree(mean, error, exact, 1e-3 * exact)
    np.testing.assert_array_equal(result.unscattered, 0.0)


def test_exits_from_a_black_medium_behind_a_rough_interface(tmp_path: Path) -> None:
    """The same by exits."""
    scene = absorbing_slab(tmp_path)
    x, w = np.polynomial.legendre.leggauss(20)
    mu, phi = 0.5 * (x + 1.0), 2.0 * np.pi * (np.arange(32) + 0.5) / 32
    r = np.sqrt(1.0 - mu**2)[:, None]
    above = np.stack([r * np.cos(phi), r * np.sin(phi), np.broadcast_to(mu[:, None], (20, 32))], axis=-1).reshape(-1, 3)
    incident = np.concatenate([above, above * [1.0, 1.0, -1.0]])
    weight = np.tile(np.repeat(0.5 * w * np.pi / 16, 32), 2)
    values = black_slab(VIEW, incident, **ABSORBING, nodes=20, orders=3)
    exact = sh.evaluate(incident, 2).T @ (weight * values)
    result = estimate_coefficients(scene, MIDDLE[None], VIEW[None], 2, 400_000, 5)
    # Sums over 20 × 40 directions inside and outside differ from those over twice as many by 2e-3 of the largest.
    assert_agree(result.mean[0, :, 0], result.standard_error[0, :, 0], exact, 2e-3 * exact[0])
