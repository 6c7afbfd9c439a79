"""Precision of the learner's matrix products: the machine's faster one, or that of the run that is resumed."""

import dataclasses

import pytest
import torch

from prt_bake.network.bssrdf import NeuralBSSRDF
from prt_bake.shipped import demonstration
from prt_bake.trainer.learning import learner as learning
from prt_bake.trainer.learning import precision
from prt_bake.trainer.learning.learner import Learner
from tests.trainer.small_training import LEARNING, SMALL, make_scene, train_small

BFLOAT16 = dataclasses.replace(LEARNING, bfloat16=True)


def learner_if(faster, monkeypatch, settings=BFLOAT16):
    """A learner on a machine that is faster in bfloat16, or not."""
    monkeypatch.setattr(learning, "bfloat16_is_faster", lambda device_type: faster)
    return Learner(NeuralBSSRDF(SMALL, [-1.0] * 3, 2.0, 0.05), settings)


class Clock:
    """Replaces the module `time` where precisions are measured; only products advance it."""

    def __init__(self, monkeypatch):
        self.now = 0.0
        monkeypatch.setattr(precision, "time", self)

    def perf_counter(self):
        return self.now


@pytest.mark.parametrize(("share", "faster"), [(0.2, True), (0.9, False), (2.0, False)])
def test_the_faster_precision_is_measured(share, faster, monkeypatch):
    """A machine whose products in bfloat16 take `share` of the time of products in float32."""

    def product(rows, weights):
        clock.now += share if rows.dtype == torch.bfloat16 else 1.0

    clock = Clock(monkeypatch)
    monkeypatch.setattr(torch.nn.functional, "linear", product)
    precision.bfloat16_is_faster.cache_clear()
    try:
        assert precision.bfloat16_is_faster("cpu") is faster
    finally:
        precision.bfloat16_is_faster.cache_clear()


def test_interrupted_measurements_do_not_count(monkeypatch):
    """Another process interrupts some of the products in bfloat16, including the last."""
    products = []

    def product(rows, weights):
        products.append(rows.dtype)
        interrupted = rows.dtype == torch.bfloat16 and products.count(rows.dtype) in (1, 3, 4, 7)
        clock.now += 10.0 if interrupted else 0.2 if rows.dtype == torch.bfloat16 else 1.0

    clock = Clock(monkeypatch)
    monkeypatch.setattr(torch.nn.functional, "linear", product)
    assert precision._speedup() > 1.3
    assert len(products) == 14


@pytest.mark.parametrize(("requested", "faster"), [(True, True), (True, False), (False, True)])
def test_products_are_in_bfloat16_if_requested_and_faster(requested, faster, monkeypatch):
    learner = learner_if(faster, monkeypatch, dataclasses.replace(LEARNING, bfloat16=requested))
    assert learner.bfloat16 is (requested and faster)
    autocast = []
    monkeypatch.setattr(
        learner.network,
        "components",
        lambda *query: autocast.append(torch.is_autocast_enabled("cpu")) or (torch.zeros(1), None),
    )
    learner._predict(torch.zeros(1, 1, 3), torch.zeros(1, 16), None)
    assert autocast == [requested and faster]


@pytest.mark.parametrize("began_with", [True, False])
def test_a_resumed_run_has_the_precision_of_its_own_machine(began_with, monkeypatch):
    state = learner_if(began_with, monkeypatch).state()
    other = learner_if(not began_with, monkeypatch)
    other.restore(state)
    assert other.bfloat16 is not began_with


@pytest.mark.parametrize(("faster", "expected"), [(True, "bfloat16"), (False, "float32")])
def test_a_model_states_its_training_precision(tmp_path, faster, expected, monkeypatch):
    monkeypatch.setattr(learning, "bfloat16_is_faster", lambda device_type: faster)
    network = train_small(make_scene(tmp_path), 2, learning=BFLOAT16)
    assert network.metadata["training"]["precision"] == expected


def test_synchronous_runs_do_not_depend_on_the_measured_precision(tmp_path, monkeypatch):
    scene, weights = make_scene(tmp_path), []
    for faster in (True, False):
        monkeypatch.setattr(learning, "bfloat16_is_faster", lambda device_type, faster=faster: faster)
        network = train_small(scene, 2, learning=BFLOAT16, synchronous=True)
        assert network.metadata["training"]["precision"] == "float32"
        weights.append(network.state_dict())
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[0])


def test_hopelessly_slow_products_are_not_repeated(monkeypatch):
    """A processor without the instructions is hundreds of times slower, seconds per product."""
    products, now = [], [0.0]

    def product(rows, weights):
        products.append(rows.dtype)
        now[0] += 0.2 if rows.dtype == torch.bfloat16 else 1e-3

    monkeypatch.setattr(torch.nn.functional, "linear", product)
    # A simulated clock: a busy machine may sleep longer than requested.
    monkeypatch.setattr(precision.time, "perf_counter", lambda: now[0])
    assert precision._speedup() < 0.1
    assert len(products) == 2


@pytest.mark.parametrize(("faster", "expected"), [(True, "bfloat16"), (False, "float32")])
def test_the_quick_demonstration_uses_bfloat16_if_faster(faster, expected, monkeypatch):
    monkeypatch.setattr(demonstration, "bfloat16_is_faster", lambda device_type: faster)
    assert demonstration.QUICK.precision == expected
    assert demonstration.FINE.precision == "float32"
