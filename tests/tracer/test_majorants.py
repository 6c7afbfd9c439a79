"""The majorants of a grid determine the cost of tracking, but not its result.

z-tests of false-alarm rate `significance.FALSE_ALARM` each, a dozen of them.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from formats.scene import Scene
from prt_bake.tracer import estimate
from prt_bake.tracer.estimate import Estimate, estimate_coefficients, estimate_transport
from prt_bake.tracer.prepared import PreparedScene
from prt_bake.tracer.volume.media import MAJORANT
from tests.mathematics.significance import assert_agree, largest_z, z_scores
from tests.tracer.scenes import lumpy, make_scene, queries, unit_directions

pytestmark = pytest.mark.statistics

GENERATOR = np.random.default_rng(21)
RARE = np.where(GENERATOR.random((24, 20, 18)) < 0.02, 60.0, GENERATOR.uniform(0.0, 2.0, (24, 20, 18)))
"""Few dense cells in a thin medium, so that there are several blocks, and free flights cross many."""
COLOURED = RARE[..., None] * [1.0, 0.3, 0.05]
GRIDS = {"grey": RARE, "coloured": COLOURED}
INTERFACES: dict[str, dict[str, Any]] = {"matched": {}, "rough": {"eta": 1.4, "roughness": 0.5}}
PATHS = 1500


def _scaled(scene: Scene, factor: float, monkeypatch: pytest.MonkeyPatch) -> PreparedScene:
    """Multiply all majorants that the estimators use by `factor`."""
    prepared = PreparedScene(scene)
    assert len(prepared.medium.blocks) > 8
    prepared.medium.blocks[:, 1] *= factor
    prepared.medium.regions[:, MAJORANT] *= factor
    monkeypatch.setattr(estimate, "prepare", lambda _scene: prepared)
    return prepared


def _estimates(scene: Scene, seed: int) -> tuple[Estimate, Estimate]:
    positions, outgoing, _ = queries(scene.mesh, 8, 3)
    incident = unit_directions(8, 4)
    return (
        estimate_transport(scene, positions, outgoing, incident, PATHS, seed),
        estimate_coefficients(scene, positions, outgoing, 1, PATHS, seed),
    )


@pytest.mark.parametrize("interface", INTERFACES)
@pytest.mark.parametrize("grid", GRIDS)
def test_larger_majorants_do_not_change_the_estimates(
    tmp_path: Path, grid: str, interface: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Free flights in walks, ratio tracking in connections and unscattered transmittances; independent seeds."""
    scene = make_scene(
        tmp_path, lumpy(2), sigma_t=GRIDS[grid], albedo=[0.95, 0.9, 0.7], phase_g=0.3, **INTERFACES[interface]
    )
    by_factor = {}
    for seed, factor in enumerate((1.0, 2.0, 10.0)):
        _scaled(scene, factor, monkeypatch)
        by_factor[factor] = _estimates(scene, seed)
    for factor in (2.0, 10.0):
        for once, more in zip(by_factor[1.0], by_factor[factor], strict=True):
            assert_agree(once.mean, once.standard_error, more.mean, more.standard_error)
            np.testing.assert_array_equal(more.lost, 0.0)
    if interface == "matched":
        shares = {factor: result[0].unscattered for factor, result in by_factor.items()}
        # A transmittance in [0, 1] has a standard deviation of at most a half.
        for factor in (2.0, 10.0):
            assert_agree(shares[1.0], 0.5 / np.sqrt(PATHS), shares[factor], 0.5 / np.sqrt(PATHS))


def test_too_small_majorants_are_detected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A tenth of the majorants misses most of the dense cells, and the comparison detects it."""
    scene = make_scene(tmp_path, lumpy(2), sigma_t=RARE, albedo=[0.95, 0.9, 0.7], phase_g=0.3)
    _scaled(scene, 1.0, monkeypatch)
    right = _estimates(scene, 0)
    _scaled(scene, 0.1, monkeypatch)
    wrong = _estimates(scene, 1)
    assert any(
        np.abs(z_scores(a.mean, a.standard_error, b.mean, b.standard_error)).max() > 2.0 * largest_z(a.mean.size)
        for a, b in zip(right, wrong, strict=True)
    )
