"""Which precision a learner's matrix work has: what the machine is faster in, and what a resumed run began with."""

import dataclasses
import time

import pytest
import torch

from prt_bake.network.bssrdf import NeuralBSSRDF
from prt_bake.shipped import demonstration
from prt_bake.trainer import learner as learning
from prt_bake.trainer import precision
from prt_bake.trainer.learner import Learner
from tests.trainer.small_training import LEARNING, SMALL, learnt, make_scene

ASKING = dataclasses.replace(LEARNING, bfloat16=True)


def learner_where(pays, monkeypatch, settings=ASKING):
    monkeypatch.setattr(learning, "bfloat16_is_faster", lambda device_type: pays)
    return Learner(NeuralBSSRDF(SMALL, [-1.0] * 3, 2.0, 0.05), settings)


@pytest.mark.parametrize(("share", "pays"), [(0.2, True), (0.9, False), (2.0, False)])
def test_what_is_faster_is_measured(share, pays, monkeypatch):
    """A machine whose products in bfloat16 take a share of the time of those in float32."""

    def product(rows, weights):
        time.sleep(2e-3 * (share if rows.dtype == torch.bfloat16 else 1.0))

    monkeypatch.setattr(torch.nn.functional, "linear", product)
    precision.bfloat16_is_faster.cache_clear()
    try:
        assert precision.bfloat16_is_faster("cpu") is pays
    finally:
        precision.bfloat16_is_faster.cache_clear()


def test_what_comes_between_does_not_count(monkeypatch):
    """Something else has the processor during some of the products in bfloat16, the last among them."""
    asked = []

    def product(rows, weights):
        asked.append(rows.dtype)
        disturbed = rows.dtype == torch.bfloat16 and asked.count(rows.dtype) in (1, 3, 4, 7)
        time.sleep(20e-3 if disturbed else 2e-3 * (0.2 if rows.dtype == torch.bfloat16 else 1.0))

    monkeypatch.setattr(torch.nn.functional, "linear", product)
    assert precision._gain() > 1.3
    assert len(asked) == 14


@pytest.mark.parametrize(("asked", "pays"), [(True, True), (True, False), (False, True)])
def test_matrix_work_is_in_bfloat16_where_it_is_asked_for_and_pays(asked, pays, monkeypatch):
    learner = learner_where(pays, monkeypatch, dataclasses.replace(LEARNING, bfloat16=asked))
    assert learner.bfloat16 is (asked and pays)
    kinds = []
    monkeypatch.setattr(
        learner.network,
        "parts",
        lambda *query: kinds.append(torch.is_autocast_enabled("cpu")) or (torch.zeros(1), None),
    )
    learner._answers(torch.zeros(1, 1, 3), torch.zeros(1, 16), None)
    assert kinds == [asked and pays]


@pytest.mark.parametrize("began_with", [True, False])
def test_a_resumed_run_goes_on_in_the_precision_it_began_with(began_with, monkeypatch):
    state = learner_where(began_with, monkeypatch).state()
    other = learner_where(not began_with, monkeypatch)
    other.restore(state)
    assert other.bfloat16 is began_with


def test_a_state_that_does_not_say_goes_on_as_the_machine_would(monkeypatch):
    learner = learner_where(True, monkeypatch)
    learner.restore({name: part for name, part in learner.state().items() if name != "bfloat16"})
    assert learner.bfloat16


@pytest.mark.parametrize(("pays", "said"), [(True, "bfloat16"), (False, "float32")])
def test_a_model_says_what_it_was_learnt_in(tmp_path, pays, said, monkeypatch):
    monkeypatch.setattr(learning, "bfloat16_is_faster", lambda device_type: pays)
    network = learnt(make_scene(tmp_path), 2, learning=ASKING)
    assert network.metadata["training"]["precision"] == said


def test_no_clock_decides_the_bits_of_a_synchronous_run(tmp_path, monkeypatch):
    scene, weights = make_scene(tmp_path), []
    for pays in (True, False):
        monkeypatch.setattr(learning, "bfloat16_is_faster", lambda device_type, pays=pays: pays)
        network = learnt(scene, 2, learning=ASKING, synchronous=True)
        assert network.metadata["training"]["precision"] == "float32"
        weights.append(network.state_dict())
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[0])


def test_products_that_are_hopeless_are_not_repeated(monkeypatch):
    """A processor without the instructions takes hundreds of times as long, seconds a product."""
    asked, now = [], [0.0]

    def product(rows, weights):
        asked.append(rows.dtype)
        now[0] += 0.2 if rows.dtype == torch.bfloat16 else 1e-3

    monkeypatch.setattr(torch.nn.functional, "linear", product)
    # A busy machine would sleep for longer than it was asked to.
    monkeypatch.setattr(precision.time, "perf_counter", lambda: now[0])
    assert precision._gain() < 0.1
    assert len(asked) == 2


@pytest.mark.parametrize(("pays", "expected"), [(True, "bfloat16"), (False, "float32")])
def test_a_demonstration_is_rounded_where_that_pays(pays, expected, monkeypatch):
    monkeypatch.setattr(demonstration, "bfloat16_is_faster", lambda device_type: pays)
    assert demonstration.QUICK.precision == expected
    assert demonstration.FINE.precision == "float32"
