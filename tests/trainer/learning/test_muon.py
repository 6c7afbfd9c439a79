"""The optimiser of the hidden layers' matrices."""

from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

from formats.errors import ModelError
from prt_bake.trainer.learning.learner import LearningSettings
from prt_bake.trainer.learning.muon import Muon, orthogonal
from tests.trainer.small_training import make_scene, train_small


@pytest.mark.parametrize("shape", [(6, 6), (4, 30), (30, 4), (1, 5)])
@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_updates_are_nearly_orthogonal_and_keep_their_directions(shape: tuple[int, int], scale: float) -> None:
    matrix = torch.from_numpy(np.random.default_rng(0).normal(size=shape)).float()
    u, _sizes, v = torch.linalg.svd(matrix, full_matrices=False)
    made = orthogonal(matrix * scale)
    inside = u.T @ made @ v.T
    assert_allclose(inside.diagonal(), 1.0, atol=0.35)
    assert_allclose(inside - inside.diagonal().diag(), 0.0, atol=1e-4)


def test_a_matrix_of_zeros_stays() -> None:
    assert not orthogonal(torch.zeros(3, 5)).any()


def test_directions_with_small_gradients_are_learnt_as_fast_as_those_with_large_ones() -> None:
    weights = torch.zeros(2, 2, requires_grad=True)
    optimiser = Muon([weights], 0.05, 0.0)
    weights.grad = -torch.diag(torch.tensor([1.0, 0.1]))
    optimiser.step()
    assert_allclose(weights.detach(), -0.05 * 0.2 * 2**0.5 * orthogonal(weights.grad), rtol=1e-5)
    assert_allclose(weights.detach().diagonal(), 0.05 * 0.2 * 2**0.5, rtol=0.35)


def test_decay_is_a_share_of_the_weights_and_weights_without_gradient_stay() -> None:
    weights, other = (torch.ones(2, 3, requires_grad=True) for _ in range(2))
    optimiser = Muon([weights, other], 0.1, 0.5)
    weights.grad = torch.zeros(2, 3)
    optimiser.step()
    assert_allclose(weights.detach(), 0.95)
    assert_allclose(other.detach(), 1.0)


def test_a_run_is_resumed_with_the_same_optimisers_only(tmp_path: Path) -> None:
    scene, output = make_scene(tmp_path), tmp_path / "m.pt"
    train_small(scene, 2, output=output)
    with pytest.raises(ModelError, match="the run began with muon True, requested is False"):
        train_small(scene, 4, output=output, resume=True, learning=LearningSettings(batch=64, muon=False))
