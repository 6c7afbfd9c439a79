"""Assessments of networks with known errors, against a simulated path tracer and against the real one."""

import numpy as np
import pytest
import trimesh
from scipy.stats import binom

from formats.mesh import build_mesh
from prt_bake.mathematics import sh
from prt_bake.mathematics.sphere import fibonacci
from prt_bake.trainer import references
from prt_bake.trainer.report.assessment import assess
from prt_bake.trainer.report.evaluation import Coefficients
from prt_bake.trainer.report.reference import PathTracer
from prt_bake.trainer.report.seams import jumps
from prt_bake.trainer.validation import _DIRECTIONS, _VALIDATION_DIRECTIONS, network_coefficients
from tests.tracer.scenes import make_scene, sphere

FALSE_ALARM = 1e-5
NODES, WEIGHTS = sh.quadrature(3)


def truth(incident, positions, outgoing):
    """A smooth Ŝ of degree 2 in ωi that varies with position and view, in three channels."""
    colour = np.array([0.9, 0.6, 0.3])
    normal_cosine = np.einsum("...c,...c->...", incident, positions)
    view_cosine = np.einsum("...c,...c->...", incident, outgoing)
    value = (1.2 + 0.8 * normal_cosine + 0.5 * view_cosine * normal_cosine) * (
        1.0 + 0.3 * positions[..., 0] * outgoing[..., 1]
    )
    return value[..., None] * colour / (4.0 * np.pi)


class Network:
    """A network whose values are those of `function`."""

    def __init__(self, function):
        self.function = function

    def evaluate(self, incident, positions, outgoing):
        incident = np.broadcast_to(incident, (len(positions), *np.shape(incident)[-2:]))
        return self.function(incident, positions[:, None], outgoing[:, None])


class NoisyTruth:
    """The truth with noise like that of walks: skewed, of relative size `noise` for one walk, shared by directions."""

    def __init__(self, noise):
        self.noise = noise

    def _factors(self, count, paths, seed):
        return np.random.default_rng(seed).gamma(paths / self.noise**2, self.noise**2 / paths, size=(count, 1, 1))

    def transport(self, positions, outgoing, incident, paths, seed):
        exact = truth(incident, positions[:, None], outgoing[:, None])
        return exact * self._factors(len(positions), paths, seed)

    def coefficients(self, positions, outgoing, paths, seed):
        nodes = np.broadcast_to(NODES, (len(positions), *NODES.shape))
        exact = np.einsum(
            "nqc,qk,q->nkc", truth(nodes, positions[:, None], outgoing[:, None]), sh.evaluate(NODES, 2), WEIGHTS
        )
        return exact * self._factors(len(positions), paths, seed)


@pytest.fixture(autouse=True)
def few_batches(monkeypatch):
    """Path tracing ends by the number of batches, not by the clock, so figures are the same on every machine."""
    monkeypatch.setattr(references, "MOST_BATCHES", 32)


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    return make_scene(tmp_path_factory.mktemp("ball"), sphere(2))


def assess_function(function, scene, seed=1, noise=1.0, queries=96, vertices=48):
    return assess(
        Network(function),
        scene,
        queries=queries,
        vertices=vertices,
        seed=seed,
        seconds=np.inf,
        tracer=NoisyTruth(noise),
    )


@pytest.mark.parametrize("factor", [1.05, 0.9])
def test_the_error_of_a_scaled_network_is_found(ball, factor):
    error = abs(factor - 1.0)
    found = assess_function(lambda *query: factor * truth(*query), ball, noise=0.5)
    for part in (found["transport"], found["coefficients"]["surface"], found["coefficients"]["vertices"]):
        assert part["network"]["value"] == pytest.approx(error, rel=0.12)
        assert part["together"] ** 2 == pytest.approx(part["network"]["value"] ** 2 + part["noise"] ** 2)
    assert found["coefficients"]["percentile_95"]["value"] == pytest.approx(error, rel=0.15)
    assert found["white_sky"]["object"]["value"] == pytest.approx(factor - 1.0, abs=0.006)
    assert found["white_sky"]["percentile_95"]["value"] == pytest.approx(error, rel=0.2)


def test_a_perfect_network_meets_every_criterion_and_one_with_ten_percent_error_none(ball):
    perfect = [row["result"] for row in assess_function(truth, ball)["criteria"]]
    assert perfect == ["met"] * 6
    poor = assess_function(lambda *query: 1.1 * truth(*query), ball)["criteria"]
    assert [row["result"] for row in poor] == ["not met"] * 5 + ["met"]


@pytest.mark.statistics
def test_intervals_contain_the_truth_as_often_as_stated(ball):
    """A network whose error varies over the object; its true errors come from 60 times as many queries."""

    def wrong(incident, positions, outgoing):
        field = 0.08 * np.sin(5.0 * positions[..., 0]) + 0.03 * positions[..., 2] + 0.04 * outgoing[..., 2]
        return truth(incident, positions, outgoing) * (1.0 + np.broadcast_to(field, incident.shape[:-1])[..., None])

    exact = assess_function(wrong, ball, seed=99, noise=0.05, queries=6000, vertices=162)
    trials, covered = 24, np.zeros(3)
    for seed in range(trials):
        found = assess_function(wrong, ball, seed=seed, noise=0.7)
        for place, (ours, true) in enumerate(
            (
                (found["transport"]["network"], exact["transport"]["network"]),
                (found["coefficients"]["surface"]["network"], exact["coefficients"]["surface"]["network"]),
                (found["white_sky"]["object"], exact["white_sky"]["object"]),
            )
        ):
            covered[place] += ours["low"] <= true["value"] <= ours["high"]
    assert (covered >= binom.ppf(FALSE_ALARM, trials, 0.92)).all(), covered


def test_noise_is_reduced_to_a_third_of_the_error_if_time_allows(ball, monkeypatch):
    monkeypatch.setattr(references, "MOST_BATCHES", 512)
    found = assess_function(lambda *query: 1.2 * truth(*query), ball, noise=2.0)
    assert found["reference"]["transport"]["ended_by"] == "noise"
    assert found["transport"]["noise"] < 1.1 * 0.2 / 3


def test_v_is_the_relative_variance_of_one_walk(ball):
    v = assess_function(truth, ball, noise=1.5, queries=400)["prediction"]["v"]
    assert v["low"] * 0.8 < 1.5**2 < v["high"] * 1.2
    assert v["value"] == pytest.approx(1.5**2, rel=0.2)


def brighter_at(condition):
    """The truth, times 1.05 for directions that fulfil a condition."""
    return lambda incident, positions, outgoing: (
        truth(incident, positions, outgoing)
        * np.where(np.broadcast_to(condition(incident, outgoing), incident.shape[:-1]), 1.05, 1.0)[..., None]
    )


def azimuth(directions):
    return np.arctan2(directions[..., 1], directions[..., 0])


def in_sector(directions):
    """Whether directions are between φ = 0 and 2 radians, clear of the poles."""
    return (azimuth(directions) > 0.0) & (azimuth(directions) < 2.0) & (np.abs(directions[..., 2]) < 0.95)


@pytest.mark.parametrize(
    ("place", "condition"),
    [
        ("seam of incident", lambda incident, outgoing: in_sector(incident)),
        ("seam of outgoing", lambda incident, outgoing: in_sector(outgoing)),
    ],
)
def test_a_step_at_the_seam_is_found_there_and_nowhere_else(place, condition):
    directions = np.random.default_rng(0).normal(size=(256, 3))
    normals = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    found = jumps(Network(brighter_at(condition)), normals, normals, 1)
    assert found[place].visible
    assert found[place].there == pytest.approx(0.05, rel=0.3)
    assert [name for name, jump in found.items() if jump.visible] == [place]


@pytest.mark.parametrize("varied", [0, 1])
def test_a_swirl_about_the_poles_is_found(varied):
    def swirl(*query):
        return (
            truth(*query)
            * (1.0 + 0.05 * np.cos(3.0 * azimuth(np.broadcast_to(query[2 * varied], query[0].shape))))[..., None]
        )

    directions = np.random.default_rng(0).normal(size=(256, 3))
    normals = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    found = jumps(Network(swirl), normals, normals, 1)
    assert [name for name, jump in found.items() if jump.visible] == [f"pole of {('incident', 'outgoing')[varied]}"]


def test_a_smooth_network_shows_neither_seam_nor_pole(ball):
    found = assess_function(lambda *query: 1.05 * truth(*query), ball)["seams"]
    assert not any(jump["visible"] for jump in found["jumps"].values())
    assert not any(row["stands_out"] for row in found["errors_near"].values())


def test_larger_errors_near_the_poles_are_significant(ball):
    def wrong(incident, positions, outgoing):
        return truth(incident, positions, outgoing) * (1.0 + 0.3 * (np.abs(incident[..., 2:]) > 0.95))

    found = assess_function(wrong, ball, noise=0.3, queries=400)["seams"]["errors_near"]
    assert found["pole of incident"]["stands_out"]
    assert not found["seam of incident"]["stands_out"]


def test_the_worst_queries_are_measured_again_without_selection_bias(ball):
    found = assess_function(truth, ball, noise=3.0, queries=400)["worst"]["rows"]
    z = np.array([row["z"] for row in found])
    assert len(z) == 10
    # Each z has seven degrees of freedom: the mean of ten exceeds 2 with negligible probability.
    assert abs(z.mean()) < 2.0


def test_only_coefficients_are_assessed_behind_a_smooth_interface(tmp_path):
    scene = make_scene(tmp_path, sphere(2), eta=1.4)
    found = assess_function(lambda *query: 1.05 * truth(*query), scene)
    assert found["transport"] is None
    assert found["prediction"]["of"] == "coefficients"
    assert found["coefficients"]["surface"]["network"]["value"] == pytest.approx(0.05, rel=0.12)
    assert "no values in this scene" in found["summary"][1]


def chord(positions, outgoing):
    """Length inside the box [−1, 1]³ of a ray that leaves its surface at `positions` along `outgoing`."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.where(outgoing > 0.0, (positions + 1.0) / outgoing, (positions - 1.0) / outgoing)
    return np.where(outgoing == 0.0, np.inf, ends).min(axis=-1)


def test_the_white_sky_error_of_a_white_box_agrees_with_theory(tmp_path):
    """Index-matched and without absorption, √(4π) a₀₀ is 1 − T. The network is 2 % above it."""
    box = trimesh.creation.box(extents=(2.0, 2.0, 2.0)).subdivide().subdivide()
    scene = make_scene(tmp_path, build_mesh(np.asarray(box.vertices), np.asarray(box.faces)), sigma_t=1.0, albedo=1.0)

    def above(incident, positions, outgoing):
        value = 1.02 * (1.0 - np.exp(-chord(positions, outgoing))) / (4.0 * np.pi)
        return np.broadcast_to(value[..., None], incident.shape)

    found = assess(Network(above), scene, queries=64, vertices=64, seed=3, seconds=np.inf)
    found = found["white_sky"]
    width = found["object"]["high"] - found["object"]["low"]
    # 95 % intervals at 2.3 times their width miss the truth once in 100,000 times.
    assert abs(found["object"]["value"] - 0.02) < 2.3 * 0.5 * width
    assert width < 0.012
    assert found["percentile_95"]["value"] == pytest.approx(0.02, abs=0.008)


def test_a_path_traced_network_has_the_error_of_its_noise(tmp_path):
    """The network is the path tracer with other walks, times 1.05."""
    scene = make_scene(tmp_path, sphere(1), sigma_t=2.0, albedo=0.8)
    tracer, paths = PathTracer(scene, 8), 32
    noise = []

    class Traced:
        def evaluate(self, incident, positions, outgoing):
            incident = np.ascontiguousarray(np.broadcast_to(incident, (len(positions), *np.shape(incident)[-2:])))
            halves = [tracer.transport(positions, outgoing, incident, paths, 77 + half) for half in range(2)]
            noise.append(np.sum((halves[0] - halves[1]) ** 2) / 4 / np.sum(halves[0] * halves[1]))
            return 1.05 * 0.5 * (halves[0] + halves[1])

    found = assess(Traced(), scene, queries=64, vertices=16, seed=3, seconds=np.inf)
    expected = np.sqrt(0.05**2 + 1.05**2 * noise[0])
    assert found["transport"]["network"]["low"] * 0.85 < expected < found["transport"]["network"]["high"] * 1.15


def test_narrow_lobes_do_not_alias_into_low_coefficients() -> None:
    """Lobes of 12°, as of light that crosses clear rough objects; too few directions would alias them."""

    def lobe(incident, positions, outgoing):
        cosine = np.einsum("...c,...c->...", incident, outgoing)
        return np.exp((cosine - 1.0) / 0.02)[..., None] * np.ones(3)

    rng = np.random.default_rng(3)
    eye = rng.normal(size=(40, 3))
    eye /= np.linalg.norm(eye, axis=1, keepdims=True)
    x = np.zeros((40, 3))
    found = Coefficients(Network(lobe), seed=5)(x, eye[:, None])[:, 0]
    lattice = fibonacci(1 << 14)
    exact = (
        4.0 * np.pi / len(lattice) * np.einsum("dk,ndc->nkc", sh.evaluate(lattice, 2), lobe(lattice, x, eye[:, None]))
    )
    assert np.linalg.norm(found - exact) < 5e-3 * np.linalg.norm(exact)
    for directions in (_DIRECTIONS, _VALIDATION_DIRECTIONS):
        coefficients = network_coefficients(Network(lobe), x, eye, directions)
        assert np.linalg.norm(coefficients - exact) < 0.05 * np.linalg.norm(exact)
