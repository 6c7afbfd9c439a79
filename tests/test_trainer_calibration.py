"""The error bars are what they say: mean ± 1.96 standard_error covers the truth in 95 % of all pairs (query, seed).

The truth is a run of TRUTH_PATHS times as many paths: its own error is 1 / √TRUTH_PATHS of a pair's and takes 0.2 %
from the coverage. A pair counts where the estimator calls it reliable. Coverage over 4,000 independent pairs has a
standard deviation of 0.35 %: 93–97 % is nearly six of them.
"""

import numpy as np
import pytest
from scenes import make_scene, queries, sphere, unit_directions

from prt_bake.trainer.estimate import estimate_coefficients, estimate_transport

QUERIES, SEEDS, LEAST_PAIRS, LEAST_QUERIES = 24, 200, 4000, 20
TRUTH_PATHS = 64
BOUND = 1.96
TRUTH_SEED = 1_000_003
MATCHED = {"sigma_t": 4.0, "albedo": [0.9, 0.7, 0.5], "phase_g": 0.0}
ROUGH = {"sigma_t": 2.0, "albedo": [0.9, 0.7, 0.5], "phase_g": 0.0, "eta": 1.3, "roughness": 0.6}


class Experiment:
    """One estimator on one scene, by paths and seed; light from the viewer's side or from behind the object."""

    def __init__(self, folder, medium, estimator, behind=False):
        self.scene = make_scene(folder, sphere(2), **medium)
        self.positions, self.outgoing, normals = queries(self.scene.mesh, QUERIES, seed=11)
        self.estimator = estimator
        towards = unit_directions(QUERIES, seed=77)
        side = np.sign(np.sum(towards * normals, axis=1, keepdims=True))
        self.incident = towards * (-side if behind else side)

    def estimate(self, paths, seed):
        if self.estimator == "coefficients":
            return estimate_coefficients(self.scene, self.positions, self.outgoing, 2, paths, seed)
        return estimate_transport(self.scene, self.positions, self.outgoing, self.incident, paths, seed)

    def coverage(self, paths, seeds=SEEDS):
        """Whether each pair's bound covers the truth [seeds,N,values], and whether it is called reliable [seeds,N]."""
        truth = self.estimate(TRUTH_PATHS * paths, TRUTH_SEED)
        estimates = [self.estimate(paths, seed) for seed in range(seeds)]
        means, errors = (np.stack([getattr(e, name) for e in estimates]) for name in ("mean", "standard_error"))
        typical = np.sqrt(np.mean(errors**2, axis=0))
        assert np.median(truth.standard_error / typical) == pytest.approx(TRUTH_PATHS**-0.5, rel=0.1)
        covered = np.abs(means - truth.mean) <= BOUND * errors
        return covered.reshape(seeds, QUERIES, -1), np.stack([e.reliable for e in estimates])


@pytest.mark.parametrize(
    ("estimator", "medium", "paths"),
    [
        ("coefficients", MATCHED, 768),
        ("coefficients", ROUGH, 768),
        ("transport", MATCHED, 640),
        ("transport", ROUGH, 896),
    ],
    ids=["coefficients-matched", "coefficients-rough", "transport-matched", "transport-rough"],
)
def test_bounds_cover_the_truth(estimator, medium, paths, tmp_path):
    covered, reliable = Experiment(tmp_path, medium, estimator).coverage(paths)
    counted = covered[reliable]
    assert len(counted) >= LEAST_PAIRS
    assert (reliable.mean(axis=0) > 0.5).sum() >= LEAST_QUERIES
    assert 0.93 <= counted.mean() <= 0.97
    each = counted.mean(axis=0)
    assert each.min() >= 0.93
    assert each.max() <= 0.97


def test_too_few_paths_for_heavy_tails_are_flagged(tmp_path):
    """Light from behind comes through rarely and strongly: the bounds fall short, and most pairs say so, near a count
    of paths that is enough for light from the viewer's side.
    """
    covered, reliable = Experiment(tmp_path, ROUGH, "transport", behind=True).coverage(640, seeds=60)
    assert reliable.mean() < 0.2
    assert covered[~reliable].mean() < 0.93


@pytest.mark.parametrize("estimator", ["coefficients", "transport"])
def test_a_value_that_no_path_has_touched_is_flagged(estimator, tmp_path):
    """0 ± 0 covers nothing: a thin medium of which all walks but one in some ten thousand come through unscattered."""
    thin = Experiment(tmp_path, {"sigma_t": 1e-4, "albedo": 0.9}, estimator)
    few = thin.estimate(64, seed=1)
    untouched = (few.standard_error == 0.0).reshape(QUERIES, -1).all(axis=1)
    assert untouched.sum() >= LEAST_QUERIES
    assert not few.reliable[untouched].any()
    assert (thin.estimate(20_000, seed=2).mean[:, ..., 0] != 0.0).any()
