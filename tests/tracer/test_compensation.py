"""Compensated rough interfaces: energy conservation, samples that follow the density, reciprocity, and agreement of the
transmitted loss with a random walk over the microsurface.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba import njit

from prt_bake.inspection.files import find_remarks
from prt_bake.mathematics.counter import begin_stream
from prt_bake.tracer.estimate import estimate_coefficients, estimate_transport
from prt_bake.tracer.surface.compensation import returned_density, sample_compensated
from prt_bake.tracer.surface.interface import rough_density
from prt_bake.tracer.surface.losses import LOSS, MEAN, furnace_loss, loss_tables
from tests.mathematics.sampling import SAMPLES, SphereCells, assert_counts_follow, assert_mean_is
from tests.mathematics.significance import assert_agree
from tests.tracer.microsurface import transmitted
from tests.tracer.rough_slab import reflect
from tests.tracer.scenes import blotches, lumpy, queries, sphere, unit_directions
from tests.tracer.test_nested import nested, small

ROOT = math.sqrt(4.0 * math.pi)
INTERFACES = [(0.3, 1.4, 0.9), (0.3, 1 / 1.4, 0.5), (0.6, 1.3, 0.2), (0.6, 1 / 2.0, 0.8), (1.0, 1.5, 0.6)]
WHITE = {"sigma_t": 3.0, "albedo": 1.0}


def table(eta, low, high=None):
    """Loss tables for both sides of an interface, for one roughness or a range."""
    denser = max(eta, 1 / eta)
    return loss_tables([denser, 1 / denser], (low, high or low))


def at_cosine(cosine):
    return np.array([math.sqrt(1 - cosine**2), 0.0, cosine])


@njit
def events(losses, alpha, eta, i, transmit_only, count):
    """Directions and weights [N,4]."""
    rows, stream = np.empty((count, 4)), np.zeros(2, np.uint64)
    for n in range(count):
        begin_stream(stream, 5, 1, n)
        rows[n] = sample_compensated(losses, alpha, eta, i[0], i[1], i[2], transmit_only, stream)
    return rows


@njit
def densities(losses, alpha, eta, i, o):
    """The complete density, and that of the compensating lobe."""
    values = np.empty((2, len(o)))
    for n in range(len(o)):
        values[1, n] = returned_density(losses, alpha, eta, i[2], o[n, 2])
        values[0, n] = values[1, n] + rough_density(alpha, eta, i[0], i[1], i[2], o[n, 0], o[n, 1], o[n, 2])
    return values


@pytest.fixture(scope="module")
def cells():
    return SphereCells(256, 256)


@pytest.mark.statistics
@pytest.mark.parametrize(("alpha", "eta", "cosine"), INTERFACES)
def test_density_integrates_to_one_and_is_sampled(alpha, eta, cosine, cells):
    """False-alarm rate `sampling.FALSE_ALARM`; the table and the integrals over cells err by about 1e-3."""
    for losses in (table(eta, alpha), table(eta, 0.05, 1.0)):
        density, returned = densities(losses, alpha, eta, at_cosine(cosine), cells.directions)
        probabilities = cells.integrate(density)
        assert probabilities.sum() == pytest.approx(1.0, abs=1.5e-3)
        assert cells.integrate(returned).sum() > 0.01
        rows = events(losses, alpha, eta, at_cosine(cosine), False, SAMPLES)
        np.testing.assert_array_equal(rows[:, 3], 1.0)
        np.testing.assert_allclose(np.linalg.norm(rows[:, :3], axis=1), 1.0, atol=1e-12)
        assert_counts_follow(cells.count(rows[:, :3]), probabilities / probabilities.sum())


@pytest.mark.parametrize(("alpha", "eta", "cosine"), INTERFACES)
def test_transmission_is_the_complement_of_reflection(alpha, eta, cosine, cells):
    losses, i = table(eta, alpha), at_cosine(cosine)
    up = cells.directions[:, 2] > 0
    density, returned = densities(losses, alpha, eta, i, cells.directions)
    transmitted_rows = events(losses, alpha, eta, i, True, SAMPLES)
    assert (transmitted_rows[:, 2] < 0).all()
    assert (transmitted_rows[:, 3] <= 1.0 + 1e-12).all()
    reflected = (events(losses, alpha, eta, i, False, SAMPLES)[:, 2] > 0).mean()
    error = math.hypot(transmitted_rows[:, 3].std(), math.sqrt(reflected * (1 - reflected))) / math.sqrt(SAMPLES)
    assert abs(transmitted_rows[:, 3].mean() + reflected - 1.0) < 5 * error
    if eta > 1:
        assert not returned[up].any()
    probabilities = cells.integrate(np.where(up, 0.0, density))
    assert_mean_is(transmitted_rows[:, 3], probabilities.sum() / cells.integrate(density).sum())


@pytest.mark.parametrize("alpha", [0.02, 0.3, 1.0])
def test_compensating_lobe_is_reciprocal(alpha):
    """iz k(i, o) = eta² |oz| k(o, i), for transmission and for reflection on either side."""
    eta = 1.4
    losses = table(eta, alpha)
    for a, b in np.random.default_rng(3).uniform(0.01, 1.0, (50, 2)):
        there = a * returned_density(losses, alpha, eta, a, -b)
        assert there == pytest.approx(eta**2 * b * returned_density(losses, alpha, 1 / eta, b, -a), rel=1e-9)
        inside = a * returned_density(losses, alpha, 1 / eta, a, b)
        assert inside == pytest.approx(b * returned_density(losses, alpha, 1 / eta, b, a), rel=1e-9)


@pytest.mark.statistics
def test_losses_are_between_0_and_1_and_grow_with_roughness():
    for eta in (1.0 + 1e-6, 1.1, 1.5, 2.5, 4.0):
        rows = table(eta, 0.01, 1.0)
        losses = rows[:, :, LOSS : LOSS + 49]
        assert losses.min() >= 0.0
        assert losses.max() <= 1.0
        assert (np.diff(rows[:, :, MEAN], axis=1) > 0.0).all()
        # The denser side can receive the loss of the rarer one, and transmits no more than its own loss.
        assert (eta**2 * rows[1, :, MEAN] >= rows[0, :, MEAN]).all()


@pytest.mark.parametrize("alpha", [0.3, 0.6, 1.0])
def test_transmission_agrees_with_the_microsurface(alpha):
    """Mean over the cosine, with all bounces. Single scattering alone is lower by 0.04, 0.12 and 0.24."""
    eta, cosines = 1.4, np.sqrt((np.arange(8) + 0.5) / 8)
    losses = table(eta, alpha)
    walked = np.mean([transmitted(c, alpha, eta, 20_000, n).mean() for n, c in enumerate(cosines)])
    ours = np.mean([events(losses, alpha, eta, at_cosine(c), True, 20_000)[:, 3].mean() for c in cosines])
    assert ours == pytest.approx(walked, abs=0.01)


def reflectance(cosines, alpha, eta):
    """R(ωo) [N] of single scattering outside, by quadrature over the second implementation of Walter's model."""
    x, w = np.polynomial.legendre.leggauss(200)
    mu, phi = 0.5 * (x + 1), np.pi * (np.arange(200) + 0.5) / 200
    r = np.sqrt(1 - mu**2)[:, None]
    o = np.stack([r * np.cos(phi), r * np.sin(phi), np.broadcast_to(mu[:, None], (200, 200))], axis=-1)
    return np.array([np.sum(reflect(at_cosine(c), o, alpha, 1.0, eta) * w[:, None]) * np.pi / 200 for c in cosines])


GRID = {"sigma_t": "sigma_t.npy", "albedo": 1.0, "bounds": [[-1.5, -1.5, -1.5], [1.5, 1.5, 1.5]]}
COMPENSATED = {"roughness": 0.3, "energy_compensation": True}
FURNACES: dict[str, tuple[Any, dict[str, Any], tuple[dict[str, Any], ...]]] = {
    "convex": (sphere(2), WHITE, ()),
    "hollows": (lumpy(2), WHITE, ()),
    "grid": (lumpy(2), GRID, ()),
    "nested": (
        lumpy(2),
        WHITE,
        ({"mesh": small(0.4), "interface": {"eta": 1.8, **COMPENSATED, "roughness": 0.6}, "medium": WHITE},),
    ),
    "bubble": (sphere(2), WHITE, ({"mesh": small(0.6), "interface": {"eta": 1.0, **COMPENSATED}},)),
}


@pytest.mark.statistics
@pytest.mark.parametrize("name", FURNACES)
def test_furnace_by_exits(name: str, tmp_path: Path) -> None:
    """Under a constant sky Ŝ and the reflection at x sum to 1 for any shape, within 3e-3 and the noise."""
    mesh, medium, inside = FURNACES[name]
    np.save(tmp_path / "sigma_t.npy", 20.0 * blotches((6, 5, 7), 1e3, 5))
    scene = nested(tmp_path, mesh, medium, {"eta": 1.4, **COMPENSATED}, *inside)
    positions, outgoing, normals = queries(scene.mesh, 30, 3)
    cosines = np.sum(outgoing * normals, axis=1)
    clear = cosines > 0.1
    result = estimate_coefficients(scene, positions[clear], outgoing[clear], 0, 2048, 1)
    furnace = ROOT * result.mean[:, 0, 0] + reflectance(cosines[clear], 0.3, 1.4)
    np.testing.assert_allclose(furnace, 1.0, atol=3e-3 + 5 * ROOT * result.standard_error[:, 0, 0].max())
    assert abs(furnace.mean() - 1.0) < 1.5e-3
    np.testing.assert_array_equal(result.lost, 0.0)


def test_furnace_by_transport(tmp_path: Path) -> None:
    """The same by connections to random directions, which use the density instead of samples."""
    scene = nested(tmp_path, sphere(2), WHITE, {"eta": 1.4, **COMPENSATED, "roughness": 0.5})
    positions, outgoing, normals = queries(scene.mesh, 4, 6)
    copies, directions = 256, 32
    incident = unit_directions(4 * copies * directions, 7).reshape(-1, directions, 3)
    result = estimate_transport(scene, np.repeat(positions, copies, 0), np.repeat(outgoing, copies, 0), incident, 32, 2)
    sums = 4.0 * np.pi * result.mean.mean(axis=1)[:, 1].reshape(4, copies)
    expected = 1.0 - reflectance(np.sum(outgoing * normals, axis=1), 0.5, 1.4)
    error = np.hypot(sums.std(axis=1, ddof=1) / np.sqrt(copies), 2e-3)
    assert_agree(sums.mean(axis=1), error, expected)


@pytest.mark.statistics
def test_furnace_loss_agrees_with_walks(tmp_path: Path) -> None:
    """`furnace_loss` assumes diffuse light inside, which holds to 2 % in this white medium."""
    scene = nested(tmp_path, sphere(2), {**WHITE, "sigma_t": 8.0}, {"eta": 1.4, "roughness": 0.3})
    positions, outgoing, normals = queries(scene.mesh, 400, 3)
    cosines = np.sum(outgoing * normals, axis=1)
    result = estimate_coefficients(scene, positions, outgoing, 0, 256, 1)
    lost = 1.0 - ROOT * result.mean[:, 0, 0] - reflectance(cosines, 0.3, 1.4)
    assert np.average(lost, weights=cosines) == pytest.approx(furnace_loss(0.3, 1.4), rel=0.02)
    assert furnace_loss(0.3, 1.4) == pytest.approx(0.29, abs=0.005)
    (remark,) = (each for each in find_remarks(scene.path) if "white furnace" in each)
    assert "'object': at roughness 0.3 and relative eta 1.4 single scattering loses 29.0% of a white furnace" in remark
    inner = {"mesh": small(0.4), "interface": {"eta": 1.4, **COMPENSATED}, "medium": WHITE}
    matched = nested(tmp_path, sphere(2), WHITE, {}, inner)
    (remark,) = (each for each in find_remarks(matched.path) if "white furnace" in each)
    assert "'inner0': at roughness 0.3 and relative eta 1.4 single scattering would lose 29.0% of a white" in remark
