"""Next-event directions through a rough boundary follow their density.

About 40 tests of false-alarm rate `sampling.FALSE_ALARM` each.
"""

import math
from collections import namedtuple

import numpy as np
import pytest
from numba import njit
from scipy.integrate import quad

from prt_bake.geometry.embree import new_ray
from prt_bake.mathematics.counter import begin_stream
from prt_bake.tracer.next_event import (
    boundary_normal,
    lobe_density,
    next_event_density,
    next_event_sampling,
    sample_next_event,
)
from prt_bake.tracer.prepared import prepare
from tests.mathematics.sampling import SAMPLES, SphereCells, assert_counts_follow
from tests.tracer.scenes import lumpy, make_scene, sphere, unit_directions

Rough = namedtuple("Rough", "alpha eta")
NORMAL = np.array([0.0, 0.0, 1.0])


@njit
def samples(boundary, kappa, w, has_normal, normal, count):
    """Sampled directions [N,3], 0 if void, and their densities [N]."""
    drawn, densities, stream = np.zeros((count, 3)), np.zeros(count), np.zeros(2, np.uint64)
    for n in range(count):
        begin_stream(stream, 8, 2, n)
        if sample_next_event(boundary, kappa, w, has_normal, normal, drawn[n], stream):
            densities[n] = next_event_density(boundary, kappa, w, has_normal, normal, drawn[n])
        else:
            drawn[n] = 0.0
    return drawn, densities


@njit
def densities_at(boundary, kappa, w, has_normal, normal, directions):
    return np.array([next_event_density(boundary, kappa, w, has_normal, normal, v) for v in directions])


@njit
def boundary_normals(boundary, normal_steps, points, w):
    """Boundary normals [N,3] for `points` and light from w [N,3], and whether there is one [N]."""
    normals, found, ray, scratch = np.zeros((len(points), 3)), np.zeros(len(points), np.bool_), new_ray(), np.zeros(3)
    for n in range(len(points)):
        found[n] = boundary_normal(boundary, normal_steps, points[n], w[n], -1, ray, scratch, normals[n])
    return normals, found


@pytest.fixture(scope="module")
def cells():
    return SphereCells(256, 512)


def light_at(cosine):
    """A direction of light at `cosine` to the boundary's normal."""
    sine = math.sqrt(1 - cosine * cosine)
    return np.array([0.6 * sine, -0.8 * sine, cosine])


@pytest.mark.parametrize("kappa", [0.5, 3.0, 30.0, 333.0])
def test_lobe_integrates_to_one(kappa):
    total = quad(lambda cosine: 2 * math.pi * lobe_density(cosine, kappa), -1.0, 1.0, points=[1 - 5 / (kappa + 5)])
    assert total[0] == pytest.approx(1.0, abs=1e-10)


@pytest.mark.statistics
@pytest.mark.parametrize("eta", [1.3, 1 / 1.3, 1.5])
@pytest.mark.parametrize("alpha", [0.15, 0.25])
@pytest.mark.parametrize("cosine", [0.98, 0.6, 0.35])
@pytest.mark.parametrize("has_normal", [True, False])
def test_directions_follow_their_density(alpha, eta, cosine, has_normal, cells):
    boundary, kappa, towards = Rough(alpha, eta), next_event_sampling(alpha, eta).kappa, light_at(cosine)
    drawn, sampled_densities = samples(boundary, kappa, towards, has_normal, NORMAL, SAMPLES)
    valid = sampled_densities > 0.0
    np.testing.assert_allclose(np.linalg.norm(drawn[valid], axis=1), 1.0, atol=1e-12)
    probabilities = cells.integrate(densities_at(boundary, kappa, towards, has_normal, NORMAL, cells.directions))
    counts = np.append(cells.count(drawn[valid]), SAMPLES - valid.sum())
    assert_counts_follow(counts, np.append(probabilities, max(0.0, 1.0 - probabilities.sum())))


def test_directions_through_a_narrow_interface_follow_snell():
    """Seven of ten directions through a nearly smooth interface are along the refracted light."""
    eta, towards = 1.3, light_at(0.6)
    drawn, _said = samples(Rough(0.002, eta), 30.0, towards, True, NORMAL, 20_000)
    refracted = towards / eta + (math.sqrt(1 - (1 - 0.6**2) / eta**2) - 0.6 / eta) * NORMAL
    assert np.mean(drawn @ refracted > math.cos(0.02)) == pytest.approx(0.7, abs=0.03)


def test_wide_interfaces_use_fewer_normal_steps():
    assert [next_event_sampling(alpha, 1.3).normal_steps for alpha in (0.01, 0.1, 0.3, 0.6)] == [3, 2, 1, 0]


def test_normal_steps_converge_to_the_refracted_ray(tmp_path):
    """On a fine ball the light refracted at the normal passes the point ever closer with more steps."""
    scene = make_scene(tmp_path, sphere(5), eta=1.4, roughness=0.1)
    boundary = prepare(scene).boundary
    points = 0.2 * unit_directions(200, 3)
    towards = unit_directions(200, 4)
    missed = []
    for normal_steps in (1, 2, 3, 6):
        normals, found = boundary_normals(boundary, normal_steps, points, towards)
        assert found.all()
        on_ball = 0.5 * normals
        cosine = np.sum(towards * normals, axis=1, keepdims=True)
        refracted = towards / 1.4 + (np.sqrt(1 - (1 - cosine**2) / 1.4**2) - cosine / 1.4) * normals
        to_ball = on_ball - points
        missed.append(np.median(np.linalg.norm(np.cross(to_ball, refracted), axis=1)))
    assert missed[1] < 0.5 * missed[0]
    assert missed[2] < 0.5 * missed[1]
    assert missed[3] < 0.02


def test_boundary_normals_face_the_light(tmp_path):
    """From inside a concave object a normal faces the light; from far outside there is none."""
    scene = make_scene(tmp_path, lumpy(), eta=1.3, roughness=0.1)
    boundary = prepare(scene).boundary
    towards = unit_directions(300, 5)
    normals, found = boundary_normals(boundary, 2, 0.05 * unit_directions(300, 6), towards)
    assert found.any()
    assert (np.sum(normals * towards, axis=1)[found] > 0.0).all()
    assert not boundary_normals(boundary, 2, 5.0 * towards, towards)[1].any()
