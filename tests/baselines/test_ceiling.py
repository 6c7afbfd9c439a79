"""The ceiling of BRDFs: closed forms, noise, and a scene."""

import numpy as np
import pytest

from prt_bake.baselines.ceiling import lambert_ceiling, measure_ceiling
from prt_bake.mathematics.sphere import fibonacci
from tests.trainer.small_training import make_scene

LATTICE = fibonacci(256)
LAMBERT = np.maximum(LATTICE[:, 2], 0.0) / np.pi


def of(transport, noise=0.0, queries=200, seed=0):
    generator = np.random.default_rng(seed)
    halves = transport[None, None, :, None] + noise * generator.normal(size=(2, queries, len(LATTICE), 3))
    return lambert_ceiling(halves[0], halves[1], np.broadcast_to(LAMBERT, (queries, len(LATTICE))))


def test_a_lambert_surface_has_no_error():
    assert of(0.7 * LAMBERT).value == pytest.approx(0.0, abs=1e-7)


def test_light_from_behind_is_an_error_of_one():
    assert of(np.maximum(-LATTICE[:, 2], 0.0)).value == pytest.approx(1.0)


def test_a_uniform_transport_keeps_the_error_of_a_clamped_cosine():
    """1 − (∫g)² / (4π ∫g²) = 1 − 1 / (4π · 2 / (3π)) = 5/8 of the squares is left."""
    assert of(np.ones(len(LATTICE))).value == pytest.approx(np.sqrt(5.0 / 8.0), rel=1e-2)


def test_noise_does_not_raise_the_ceiling():
    """Noise as large as the signal leaves the figure within its interval, which is narrow."""
    transport = 0.7 * LAMBERT + 0.1
    clean, noisy = of(transport), of(transport, noise=0.2, queries=4000)
    assert noisy.low < clean.value < noisy.high
    assert noisy.high - noisy.low < 0.1 * clean.value


def test_a_query_without_light_is_all_error():
    transport = np.ones((8, 4, 3))
    assert lambert_ceiling(transport, transport, np.zeros((8, 4))).value == 1.0


def test_a_scene_has_a_ceiling(tmp_path):
    """A dense medium reflects more like a Lambert surface than it transmits; a smooth interface has no values."""
    rough = make_scene(tmp_path, eta=1.3, roughness=0.4)
    found = measure_ceiling(rough, queries=100, directions=32, walks=8)
    assert 0.2 < found.transport.value < 1.0
    assert 0.2 < found.coefficients.value < 1.0
    assert 0.05 < found.behind.value < 0.7
    # What comes from behind is beyond a BRDF, whatever it does in front.
    smooth = measure_ceiling(make_scene(tmp_path, eta=1.3), queries=16, directions=16, walks=4)
    assert smooth.transport is smooth.behind is None
