"""The path tracer against Mitsuba 3, an independent renderer, query by query on scenes of both kinds.

Every value's z-score counts both renderers' noise. The largest |z| of all values of a scene may pass its bound once in
10,000 draws of the seeds; behind rough interfaces, where tails are heavy, only values that the estimator itself calls
reliable are taken one by one, and the sum over all queries is compared besides.
"""

import numpy as np
import pytest
from scenes import lumpy, make_scene, queries, sphere, unit_directions
from significance import assert_agree

from prt_bake.trainer.estimate import estimate_transport

GRIDS = np.random.default_rng(0)
SIGMA_T, ALBEDO = GRIDS.uniform(0.5, 6.0, (4, 5, 6)), GRIDS.uniform(0.5, 1.0, (3, 4, 3, 3))
SCENES = {
    "sphere, index-matched": (sphere, {"sigma_t": 3.0, "albedo": [0.9, 0.6, 0.99], "phase_g": 0.5}, 20_000),
    "non-convex grid, index-matched": (lumpy, {"sigma_t": SIGMA_T, "albedo": ALBEDO, "phase_g": -0.3}, 20_000),
    "sphere, rough": (sphere, {"sigma_t": 2.0, "albedo": [0.9, 0.6, 0.99], "eta": 1.4, "roughness": 0.4}, 25_000),
    "non-convex grid, rough": (
        lumpy,
        {"sigma_t": SIGMA_T, "albedo": ALBEDO, "phase_g": 0.3, "eta": 1.3, "roughness": 0.5},
        25_000,
    ),
}
QUERIES = 10


@pytest.mark.parametrize("name", SCENES)
def test_values_agree(name, tmp_path):
    from mitsuba_reference import transport

    shape, medium, paths = SCENES[name]
    scene = make_scene(tmp_path, shape(), **medium)
    positions, outgoing, _ = queries(scene.mesh, QUERIES, seed=5)
    incident = unit_directions(QUERIES, seed=9)
    ours = estimate_transport(scene, positions, outgoing, incident, paths=2 * paths, seed=1)
    theirs = [
        transport(scene, *query, paths, seed)
        for seed, query in enumerate(zip(positions, outgoing, incident, strict=True))
    ]
    mean, error = (np.array(part) for part in zip(*theirs, strict=True))
    told = ours.reliable
    assert told.sum() >= QUERIES // 2
    assert_agree(mean[told], error[told], ours.mean[told], ours.standard_error[told])
    total, total_error = mean.sum(axis=0), np.sqrt(np.sum(error**2, axis=0))
    our_error = np.sqrt(np.sum(ours.standard_error**2, axis=0))
    assert_agree(total, total_error, ours.mean.sum(axis=0), our_error)
