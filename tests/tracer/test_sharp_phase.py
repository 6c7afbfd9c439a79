"""Phase functions at the limits of the allowed range, g = ±0.99.

z-tests at `significance.FALSE_ALARM` for all values of a test together.
"""

from pathlib import Path

import numpy as np
import pytest

from prt_bake import estimate_coefficients, estimate_transport
from tests.mathematics.significance import assert_agree
from tests.tracer.optical_depth import optical_depth, single_scattering
from tests.tracer.scenes import lumpy, make_scene, queries, sphere, unit_directions

pytestmark = pytest.mark.statistics

EDGES = (-0.99, 0.99)


@pytest.mark.parametrize("phase_g", EDGES)
def test_furnace(tmp_path: Path, phase_g: float) -> None:
    """Every walk exits with throughput 1."""
    scene = make_scene(tmp_path, lumpy(2), sigma_t=20.0, albedo=1.0, phase_g=phase_g)
    positions, outgoing, normals = queries(scene.mesh, 30, 1)
    result = estimate_coefficients(scene, positions, outgoing, 0, 1024, 1)
    total = np.sqrt(4.0 * np.pi) * result.mean[:, 0] + result.unscattered[:, None]
    np.testing.assert_allclose(total, 1.0, rtol=1e-12)
    rows = zip(positions - 1e-9 * normals, -outgoing, strict=True)
    straight = np.exp([-optical_depth(scene, x[None], d)[0] for x, d in rows])
    assert_agree(result.unscattered, np.sqrt(straight * (1.0 - straight) / result.paths), straight)


@pytest.mark.parametrize("phase_g", EDGES)
def test_single_scattering(tmp_path: Path, phase_g: float) -> None:
    """Ŝ / ε at an albedo of ε = 1e-6, near the peak (at 1e-3 to 0.3 rad) and far from it."""
    epsilon = 1e-6
    scene = make_scene(tmp_path, sphere(2), sigma_t=3.0, albedo=epsilon, phase_g=phase_g)
    positions, outgoing, _ = queries(scene.mesh, 10, 1)
    peak = -np.sign(phase_g) * outgoing
    angles = np.array([1e-3, 3e-3, 0.01, 0.03, 0.1, 0.3, 1.0, 1.5, 2.0, 3.0])
    across = np.cross(peak, unit_directions(10, 4))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    incident = np.cos(angles)[:, None] * peak + np.sin(angles)[:, None] * across
    result = estimate_transport(scene, positions, outgoing, incident, 20_000, 3)
    rows = zip(positions, outgoing, incident, strict=True)
    exact = np.array([single_scattering(scene, *row, steps=800) for row in rows])
    assert exact.max() > 1e5 * exact.min()
    # 800 midpoints err by 1e-3; a second scattering adds about 1e-6 per optical depth.
    error = np.hypot(result.standard_error[:, 1] / epsilon, 1e-3 * exact)
    assert_agree(result.mean[:, 1] / epsilon, error, exact)
