"""The path tracer compared with Mitsuba 3, an independent renderer, query by query.

z-scores include the noise of both renderers. The largest |z| of a scene's values exceeds its bound for one in 10,000
seeds. Individual values are compared only if the estimator calls them reliable, since rough interfaces have heavy
tails; the sum over all queries is compared too.
"""

import numpy as np
import pytest

from prt_bake.tracer.estimate import estimate_coefficients, estimate_transport
from tests.mathematics.significance import assert_agree
from tests.tracer.nested_scenes import nested_scene
from tests.tracer.scenes import lumpy, make_scene, moved, queries, sphere, unit_directions

pytestmark = pytest.mark.statistics

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
QUERIES = 7

HAZE = {"sigma_t": 3.0, "albedo": [0.9, 0.6, 0.99], "phase_g": 0.3}
MILK = {"sigma_t": [9.0, 4.0, 1.0], "albedo": [0.99, 0.8, 0.5]}
ROUGH = {"eta": 1.3, "roughness": 0.5}
CORE = moved(sphere(2), 0.5)
NESTED = {
    "milk by channel in haze": ({}, {"mesh": CORE, "medium": MILK}),
    "diffuse ball in haze": ({}, {"mesh": CORE, "surface": "diffuse", "reflectance": [0.9, 0.2, 0.5]}),
    "rough glass in haze": ({}, {"mesh": CORE, "interface": {"eta": 1.5, "roughness": 0.4}}),
    "diffuse ball behind a rough boundary": (
        ROUGH,
        {"mesh": CORE, "surface": "diffuse", "reflectance": [0.9, 0.2, 0.5]},
    ),
    "rough milk behind a rough boundary": (
        ROUGH,
        {"mesh": CORE, "interface": {"eta": 1.5, "roughness": 0.4}, "medium": MILK},
    ),
}
SMOOTH = {
    "a bubble in smooth glass": ({"eta": 1.5}, {"mesh": CORE, "interface": {"eta": 1.0}}),
    "smooth glass in haze": ({}, {"mesh": CORE, "interface": {"eta": 1.5}}),
    "smooth milk behind a rough boundary": (ROUGH, {"mesh": CORE, "interface": {"eta": 1.6}, "medium": MILK}),
}
NESTED_QUERIES = 5


@pytest.mark.parametrize("name", SCENES)
def test_values_agree(name, tmp_path):
    from tests.tracer.mitsuba_reference import transport

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
    kept = ours.reliable
    assert kept.sum() >= QUERIES // 2
    assert_agree(mean[kept], error[kept], ours.mean[kept], ours.standard_error[kept])
    total, total_error = mean.sum(axis=0), np.sqrt(np.sum(error**2, axis=0))
    our_error = np.sqrt(np.sum(ours.standard_error**2, axis=0))
    assert_agree(total, total_error, ours.mean.sum(axis=0), our_error)


@pytest.mark.parametrize("name", NESTED)
def test_values_of_nested_parts_agree(name, tmp_path):
    from tests.tracer.mitsuba_reference import transport

    interface, inside = NESTED[name]
    scene = nested_scene(tmp_path, lumpy(2), HAZE, (inside,), **interface)
    positions, outgoing, _ = queries(scene.mesh, NESTED_QUERIES, seed=5)
    incident = unit_directions(NESTED_QUERIES, seed=9)
    ours = estimate_transport(scene, positions, outgoing, incident, paths=40_000, seed=1)
    theirs = [
        transport(scene, *query, 15_000, seed)
        for seed, query in enumerate(zip(positions, outgoing, incident, strict=True))
    ]
    mean, error = (np.array(part) for part in zip(*theirs, strict=True))
    kept = ours.reliable
    assert kept.sum() > NESTED_QUERIES // 2
    assert_agree(mean[kept], error[kept], ours.mean[kept], ours.standard_error[kept])


@pytest.mark.parametrize("name", SMOOTH)
def test_sums_agree_behind_smooth_boundaries(name, tmp_path):
    """All light at x from a white sky through smooth boundaries, scattered or not."""
    from tests.tracer.mitsuba_reference import under_white_sky

    interface, inside = SMOOTH[name]
    scene = nested_scene(tmp_path, lumpy(2), HAZE, (inside,), **interface)
    positions, outgoing, _ = queries(scene.mesh, NESTED_QUERIES, seed=5)
    ours = estimate_coefficients(scene, positions, outgoing, 0, paths=40_000, seed=1)
    theirs = [
        under_white_sky(scene, *query, 15_000, seed) for seed, query in enumerate(zip(positions, outgoing, strict=True))
    ]
    mean, error = (np.array(part) for part in zip(*theirs, strict=True))
    root = np.sqrt(4.0 * np.pi)
    total = root * ours.mean[:, 0] + ours.unscattered[:, None]
    assert_agree(mean, error, total, root * ours.standard_error[:, 0])
