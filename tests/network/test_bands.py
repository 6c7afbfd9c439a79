"""Bands of lobes: a few directions integrate them exactly, and they are the bands of the lobes."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import special

from formats.mesh import build_mesh
from prt_bake.baking.bake import bake
from prt_bake.mathematics import sh
from prt_bake.mathematics.sphere import fibonacci, uniform
from prt_bake.network.bssrdf import NeuralBSSRDF
from prt_bake.network.lobes import _bessel_ratios, decode_lobes, evaluate_lobes
from prt_bake.trainer.report.evaluation import Coefficients
from prt_bake.trainer.validation import network_coefficients
from tests.network import WITHOUT_MESH
from tests.network.test_lobes import LOBED, glass_ball, lobe_parameters, lobed, unit
from tests.shapes import ball

pytestmark = WITHOUT_MESH

MANY = 40_000


def coefficients_of(lobes, directions, degree, band=None):
    """a_lm [N,K,3] of lobes by an equal-weight sum over a lattice of directions."""
    lattice = fibonacci(directions)
    values = evaluate_lobes(lobes, torch.from_numpy(lattice).float().expand(len(lobes.axes), -1, 3), band)
    return 4.0 * np.pi / directions * np.einsum("dk,ndc->nkc", sh.evaluate(lattice, degree), values.double().numpy())


@pytest.mark.parametrize("degree", [0, 1, 2, 5])
@pytest.mark.parametrize("spread", [0.0, 3.0])
def test_bands_are_those_of_the_lobes_and_higher_bands_are_zero(degree, spread):
    """At a spread of 3 some lobes have the maximum sharpness and some the minimum."""
    lobes = decode_lobes(lobe_parameters(6, 3, spread), unit(6, 4))
    found, expected = (coefficients_of(lobes, MANY, degree + 2, band) for band in (degree, None))
    size = np.abs(expected[:, 0]).max(axis=0)
    kept = sh.count(degree)
    np.testing.assert_allclose(found[:, :kept] / size, expected[:, :kept] / size, atol=2e-3)
    np.testing.assert_allclose(found[:, kept:] / size, 0.0, atol=2e-3)


def test_band_weights_are_ratios_of_bessel_functions():
    """Compared with SciPy's from the minimum to the maximum sharpness, up to bands that are 0."""
    kappa = np.exp(np.linspace(1.6, 5.5, 9))
    found = torch.stack(_bessel_ratios(torch.from_numpy(kappa), 40)).numpy()
    expected = np.stack([special.ive(band + 0.5, kappa) / special.ive(0.5, kappa) for band in range(41)])
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def lobes_alone(views=20):
    """A network whose layers output 0, so that only its lobes remain, and views of it."""
    network = lobed()
    with torch.no_grad():
        network.output.weight.zero_()
        network.output.bias.zero_()
    return network, uniform(views, 1) * 0.45 + 0.5, uniform(views, 1)


@pytest.mark.statistics
def test_few_directions_integrate_bands_exactly():
    """64 directions have an error of more than 10 % for lobes, and none for bands."""
    network, x, eye = lobes_alone(5)
    truth = network_by_values(network, x, eye, MANY)
    assert relative(network_by_values(network, x, eye, 64), truth) > 0.1
    assert relative(network_coefficients(network, x, eye, 64), truth) < 2e-3


def test_a_report_evaluates_bands_only():
    network, x, eye = lobes_alone()
    found = Coefficients(network, 0)(x, eye[:, None])[:, 0]
    assert relative(found, network_coefficients(network, x, eye, 4096)) < 1e-5


def network_by_values(network, positions, outgoing, directions):
    lattice = fibonacci(directions)
    values = network.evaluate(lattice, positions, outgoing).astype(np.float64)
    return 4.0 * np.pi / directions * np.einsum("dk,ndc->nkc", sh.evaluate(lattice, 2), values)


def relative(found, truth):
    return float(np.sqrt(((found - truth) ** 2).sum() / (truth**2).sum()))


@pytest.mark.statistics
def test_a_bake_evaluates_bands_only():
    """64 directions per bin compared with 4096: the remaining error is that of the layers, not of the lobes."""
    network = lobed()
    mesh = build_mesh(0.5 + 0.45 * np.asarray(ball(1).positions), np.asarray(ball(1).faces))
    few, many = (bake(network, mesh, rings=2, sectors=4, samples=samples) for samples in (64, 4096))
    with_lobes = bake(network.prepared(), mesh, rings=2, sectors=4, samples=64)
    assert relative(few.coefficients, many.coefficients) < 0.1 * relative(with_lobes.coefficients, many.coefficients)


def test_limiting_a_network_leaves_the_original_unchanged():
    network = lobed()
    limited = network.up_to(2)
    assert (network.band, limited.band) == (None, 2)
    assert limited.output.weight is network.output.weight
    plain = NeuralBSSRDF(replace(LOBED, lobes=0), interior=glass_ball(1.4))
    assert plain.up_to(2) is plain
