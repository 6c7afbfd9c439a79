"""Calibration of the error bars: mean ± 1.96 standard_error covers the truth in 95 % of all pairs (query, seed).

The truth of a pair is the mean over the other seeds of its query, which share no path with it. With 209 others its
error is 1 / √209 of a pair's and lowers the coverage by less than 0.1 %. Only pairs that the estimator calls reliable
count; four in five must be. Coverage over 2,000 pairs has a standard deviation of 0.5 %, so that 93–97 % is ±4 of them;
the most expensive scene has 1,680 pairs and 0.53 %.
"""

import numpy as np
import pytest

from prt_bake.tracer.estimate import estimate_coefficients, estimate_transport
from tests.tracer.nested_scenes import nested_scene
from tests.tracer.scenes import lumpy, make_scene, moved, queries, sphere, unit_directions, with_uv

pytestmark = pytest.mark.statistics

QUERIES, SEEDS = 24, 210
FEWER_QUERIES, FEWEST_QUERIES = 12, 8
BOUND = 1.96
MATCHED = {"sigma_t": 4.0, "albedo": [0.9, 0.7, 0.5], "phase_g": 0.0}
ROUGH = {"sigma_t": 2.0, "albedo": [0.9, 0.7, 0.5], "phase_g": 0.0, "eta": 1.3, "roughness": 0.6}
NARROW = {"sigma_t": 4.0, "albedo": [0.98, 0.9, 0.75], "phase_g": 0.3, "eta": 1.3, "roughness": 0.25}
THICK = {"sigma_t": 20.0, "albedo": [0.9, 0.7, 0.5], "phase_g": 0.5, "eta": 1.3, "roughness": 0.3}


class Experiment:
    """One estimator on one scene, with light from all sides, or only from behind the object."""

    def __init__(self, folder, mesh, medium, estimator, behind=False, count=QUERIES):
        self.scene = make_scene(folder, mesh, **medium)
        self.positions, self.outgoing, normals = queries(self.scene.mesh, count, seed=11)
        self.estimator = estimator
        self.incident = unit_directions(count, seed=77)
        if behind:
            self.incident *= -np.sign(np.sum(self.incident * normals, axis=1, keepdims=True))

    def estimate(self, paths, seed):
        if self.estimator == "coefficients":
            return estimate_coefficients(self.scene, self.positions, self.outgoing, 2, paths, seed)
        return estimate_transport(self.scene, self.positions, self.outgoing, self.incident, paths, seed)

    def coverage(self, paths, seeds=SEEDS):
        """Whether the bound of each pair covers the truth [seeds,N,values], and whether it is reliable [seeds,N]."""
        estimates = [self.estimate(paths, seed) for seed in range(seeds)]
        means, errors = (np.stack([getattr(e, name) for e in estimates]) for name in ("mean", "standard_error"))
        truths = (means.sum(axis=0) - means) / (seeds - 1)
        covered = np.abs(means - truths) <= BOUND * errors
        return covered.reshape(seeds, len(self.positions), -1), np.stack([e.reliable for e in estimates])


@pytest.mark.parametrize(
    ("estimator", "mesh", "medium", "paths", "count"),
    [
        ("coefficients", sphere(2), MATCHED, 768, FEWER_QUERIES),
        ("coefficients", sphere(2), ROUGH, 768, FEWER_QUERIES),
        ("transport", sphere(2), MATCHED, 1024, FEWER_QUERIES),
        ("transport", lumpy(2), ROUGH, 1024, FEWER_QUERIES),
        ("transport", sphere(2), NARROW, 1024, FEWEST_QUERIES),
    ],
    ids=[
        "coefficients-matched",
        "coefficients-rough",
        "transport-matched",
        "transport-rough-hollows",
        "transport-narrow",
    ],
)
def test_bounds_cover_the_truth(estimator, mesh, medium, paths, count, tmp_path):
    covered, reliable = Experiment(tmp_path, mesh, medium, estimator, count=count).coverage(paths)
    counted = covered[reliable]
    assert len(counted) >= 0.8 * count * SEEDS
    assert (reliable.mean(axis=0) > 0.5).sum() >= count - 2
    assert 0.93 <= counted.mean() <= 0.97
    each = counted.mean(axis=0)
    assert each.min() >= 0.93
    assert each.max() <= 0.97


def test_too_few_paths_for_heavy_tails_are_unreliable(tmp_path):
    """Light from behind a thick object comes in rare, strong paths: bounds are too narrow and flagged as unreliable."""
    thick = Experiment(tmp_path, sphere(2), THICK, "transport", behind=True, count=FEWER_QUERIES)
    covered, reliable = thick.coverage(1024, seeds=20)
    assert reliable.mean() < 0.1
    assert covered[~reliable].mean() < 0.93


@pytest.mark.parametrize("sharp", [{"phase_g": 0.9}, {"phase_g": -0.9}, {"eta": 1.3, "roughness": 0.05}])
def test_sharp_lobe_requires_many_paths(sharp, tmp_path):
    """A sample that missed all strong paths looks perfect, so the scene determines the required number."""
    for estimator, expected in (("transport", False), ("coefficients", True)):
        few = Experiment(tmp_path, sphere(2), MATCHED | sharp, estimator).estimate(4096, seed=1)
        assert few.reliable.any() == expected


@pytest.mark.parametrize("estimator", ["coefficients", "transport"])
def test_value_without_any_contribution_is_unreliable(estimator, tmp_path):
    """0 ± 0 covers nothing: in this thin medium only one walk in ten thousand scatters."""
    thin = Experiment(tmp_path, sphere(2), {"sigma_t": 1e-4, "albedo": 0.9}, estimator)
    few = thin.estimate(64, seed=1)
    untouched = (few.standard_error == 0.0).reshape(QUERIES, -1).all(axis=1)
    assert untouched.sum() >= 20
    assert not few.reliable[untouched].any()
    assert (thin.estimate(20_000, seed=2).mean[:, ..., 0] != 0.0).any()


def test_dark_values_get_an_upper_bound(tmp_path):
    """From behind a thick body hardly any path arrives: with enough paths the bound is small and covers what they
    miss.
    """
    thick = Experiment(tmp_path, sphere(2), {"sigma_t": 15.0, "albedo": [0.97, 0.5, 0.1]}, "transport", behind=True)
    few, many, truth = (thick.estimate(paths, seed) for paths, seed in ((1024, 1), (16384, 2), (65536, 3)))
    rare = ~few.reliable
    assert rare.sum() >= 10
    assert many.reliable.mean() >= 0.9
    # The bound includes fewer than three in 16,384 walks with the contribution of a white diffuse surface.
    unseen = 3 / (np.pi * 16384)
    bounded = (BOUND * many.standard_error >= unseen) & (many.mean + BOUND * many.standard_error < 1e-3 / (4 * np.pi))
    assert bounded[rare].any(axis=1).sum() >= 10
    assert bounded[many.mean < 1e-12].all()
    assert (np.abs(many.mean - truth.mean) <= BOUND * many.standard_error)[bounded].mean() >= 0.95


def test_refraction_inside_requires_more_paths(tmp_path):
    """Refracted light reaches the boundary by chance only: four times as many. A texture counts on average."""
    inner = {"mesh": moved(sphere(2), 0.4), "name": "ice", "interface": {"eta": 1.1}, "medium": MATCHED}
    for name, inside, roughness, paths in (
        ("plain", (), 0.25, 1024),
        ("nested", (inner,), 0.25, 4096),
        ("matched", (inner | {"interface": {"eta": 1.3}},), 0.25, 1024),
        ("textured", (), np.array([[0.125, 0.25], [0.25, 0.25]]), 1792),
    ):
        (tmp_path / name).mkdir()
        scene = nested_scene(tmp_path / name, with_uv(sphere(2)), MATCHED, inside, eta=1.3, roughness=roughness)
        positions, outgoing, _ = queries(scene.mesh, 24, seed=11)
        result = [
            estimate_transport(scene, positions, outgoing, outgoing, n, 1).reliable.any() for n in (paths - 1, paths)
        ]
        assert result == [False, True], name
