"""The path tracer against Mitsuba 3, an independent renderer, query by query on scenes of both kinds.

Every value's z-score counts both renderers' noise. Over all scenes there are 96 values; a bound of 4.2 on the largest
and of 1.35 on their root mean square raise a false alarm about once in 300 runs (fixed seeds: the outcome is always
the same).

Queries are seen from within 70° of the normal: Mitsuba starts its rays a little inside the surface (some 1e-4 of the
object), which at grazing views lengthens thin chords by several percent.
"""

import numpy as np
import pytest
from scenes import lumpy, make_scene, queries, sphere, unit_directions

from prt_bake.trainer.estimate import estimate_transport

pytest.importorskip("mitsuba", reason="the extra `validate`")

GRIDS = np.random.default_rng(0)
SIGMA_T, ALBEDO = GRIDS.uniform(0.5, 6.0, (4, 5, 6)), GRIDS.uniform(0.5, 1.0, (3, 4, 3, 3))
SCENES = {
    "sphere, index-matched": (sphere, {"sigma_t": 3.0, "albedo": [0.9, 0.6, 0.99], "phase_g": 0.8}, 12_000),
    "non-convex grid, index-matched": (lumpy, {"sigma_t": SIGMA_T, "albedo": ALBEDO, "phase_g": -0.3}, 12_000),
    "sphere, rough": (sphere, {"sigma_t": 2.0, "albedo": [0.9, 0.6, 0.99], "eta": 1.4, "roughness": 0.4}, 20_000),
    "non-convex grid, rough": (
        lumpy,
        {"sigma_t": SIGMA_T, "albedo": ALBEDO, "phase_g": 0.3, "eta": 1.3, "roughness": 0.5},
        20_000,
    ),
}
QUERIES = 8


@pytest.mark.parametrize("name", SCENES)
def test_values_agree(name, tmp_path):
    from mitsuba_reference import transport

    shape, medium, paths = SCENES[name]
    scene = make_scene(tmp_path, shape(), **medium)
    positions, outgoing, normals = queries(scene.mesh, 10 * QUERIES, seed=5)
    steep = np.flatnonzero(np.sum(outgoing * normals, axis=1) > np.cos(np.radians(70)))[:QUERIES]
    positions, outgoing = positions[steep], outgoing[steep]
    incident = unit_directions(QUERIES, seed=9)
    ours = estimate_transport(scene, positions, outgoing, incident, paths=4 * paths, seed=1)
    theirs = [
        transport(scene, *query, paths, seed)
        for seed, query in enumerate(zip(positions, outgoing, incident, strict=True))
    ]
    mean, error = (np.array(part) for part in zip(*theirs, strict=True))
    z = (mean - ours.mean) / np.hypot(error, ours.standard_error)
    assert np.isfinite(z).all()
    assert np.abs(z).max() < 4.2
    assert np.sqrt(np.mean(z**2)) < 1.35
    # The same statement in sums, where heavy tails weigh less: within four standard errors of the total.
    total_error = np.sqrt(np.sum(error**2 + ours.standard_error**2))
    assert abs(mean.sum() - ours.mean.sum()) < 4.0 * total_error * np.sqrt(3)
