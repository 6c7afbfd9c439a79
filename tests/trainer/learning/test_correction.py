"""Fitting a correction: the values of a network get the coefficients of its low bands."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from prt_bake.mathematics import sh
from prt_bake.mathematics.sphere import fibonacci
from prt_bake.network.bssrdf import NetworkSettings, NeuralBSSRDF
from prt_bake.network.low_bands import LowBands, correction_inputs
from prt_bake.trainer.learning import correction
from prt_bake.trainer.learning.correction import fit_correction
from prt_bake.trainer.learning.learner import LearningSettings
from prt_bake.trainer.samples.traced import Traced
from tests.network import WITHOUT_MESH
from tests.network.test_lobes import glass_ball
from tests.network.test_low_bands import SETTINGS, network
from tests.trainer.learning.test_low_bands import queries

pytestmark = WITHOUT_MESH
WIDE = replace(SETTINGS, low_width=32)


def some_queries(count: int, seed: int) -> Traced:
    return queries(count, 1, np.random.default_rng(seed))


def off(made: NeuralBSSRDF, seed: int = 9) -> float:
    """RMS of the low bands less the coefficients of the values, over views that no fit has seen."""
    views, lattice = some_queries(300, seed).views, fibonacci(256)
    positions, outgoing = views[:, :3].double().numpy(), views[:, 3:].double().numpy()
    values = made.smooth(2).evaluate(lattice, positions, outgoing).astype(np.float64)
    of_values = np.einsum("kd,ndc->nkc", np.linalg.pinv(sh.evaluate(lattice, 6))[:9], values)
    with torch.no_grad():
        low = made.low_coefficients(views[:, :3].double(), views[:, 3:]).double().numpy() * made.output_scale
    return float(np.sqrt(np.mean((low - of_values) ** 2)))


def mostly_lobes(settings: NetworkSettings) -> NeuralBSSRDF:
    """A network whose lobes, if it has any, are most of its values."""
    made = network(settings)
    if made.lobes is not None:
        with torch.no_grad():
            made.output.weight.mul_(0.1)
    return made


@pytest.mark.parametrize(("lobes", "left"), [(0, 0.25), (3, 0.21)])
def test_values_get_the_coefficients_of_the_low_bands(lobes: int, left: float) -> None:
    """To a quarter of their difference, on any number of threads; without the lobes to a quarter at best."""
    plain, made, again = (mostly_lobes(replace(WIDE, lobes=lobes)) for _ in range(3))
    learning = LearningSettings(low_batch=64)
    shares = list[float]()
    fit_correction(made, some_queries(4000, 1), learning, 0, 0, steps=400, follow=shares.append)
    np.testing.assert_allclose(shares, np.arange(400) / 400)
    assert off(made) < left * off(plain)
    fit_correction(again, some_queries(4000, 1), learning, 0, 3, steps=400)
    for weights, repeated in zip(made.parameters(), again.parameters(), strict=True):
        assert torch.equal(weights, repeated)


@pytest.mark.parametrize("share", [0.5, 1.0, 2.5])
def test_the_network_gets_the_average_if_that_gains_anything(monkeypatch: pytest.MonkeyPatch, share: float) -> None:
    """A share of the right correction, which is the same at all views."""
    targets = torch.linspace(-1.0, 1.0, 27)

    def differences(made: Any, views: Any, _turns: Any) -> tuple[torch.Tensor, torch.Tensor]:
        count = len(views.positions)
        return torch.zeros(count, correction_inputs(made.settings)), targets.view(9, 3).expand(count, 9, 3)

    def fit(layers: LowBands, average: LowBands, *_rest: Any) -> None:
        assert layers is not average
        with torch.no_grad():
            average.output.weight.zero_()
            average.output.bias.zero_()[:27] = share * targets

    monkeypatch.setattr(correction, "_differences", differences)
    monkeypatch.setattr(correction, "fit_layers", fit)
    made = network()
    fit_correction(made, some_queries(100, 2), LearningSettings(), 0, 0)
    assert (made.correction is not None) == (share < 2.0)
    if made.correction is not None:
        assert torch.equal(made.correction.output.bias[:27], share * targets)


def test_nothing_else_changes() -> None:
    made, plain = network(), network()
    fit_correction(made, some_queries(100, 2), LearningSettings(low_batch=16), 0, 0, steps=4)
    for name, weights in plain.named_parameters():
        assert torch.equal(weights, made.get_parameter(name)), name


def count_new_views(monkeypatch: pytest.MonkeyPatch, at_most: int, **arguments: Any) -> tuple[int, int]:
    """How many batches were evaluated, and how many steps were taken."""
    evaluated, shares, evaluate = list[int](), list[float](), correction._differences

    def counted(made: NeuralBSSRDF, views: Any, turns: np.random.Generator) -> Any:
        evaluated.append(len(views.positions))
        return evaluate(made, views, turns)

    monkeypatch.setattr(correction, "_differences", counted)
    monkeypatch.setattr(correction, "_MOST_VIEWS", at_most)
    fit_correction(
        network(), some_queries(200, 3), LearningSettings(low_batch=16), 0, 0, follow=shares.append, **arguments
    )
    assert set(evaluated) <= {16}
    return len(evaluated), len(shares)


@pytest.mark.parametrize(("steps", "at_most", "new"), [(20, 1 << 18, 12), (20, 64, 5), (1, 1 << 18, 2)])
def test_new_views_are_evaluated_until_half_of_the_fit_is_over(
    monkeypatch: pytest.MonkeyPatch, steps: int, at_most: int, new: int
) -> None:
    """And once more, to see what it gains."""
    assert count_new_views(monkeypatch, at_most, steps=steps) == (new, steps)


def test_a_fit_ends_with_the_time_or_the_most_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    assert count_new_views(monkeypatch, 64, seconds=0.0) == (1, 0)
    monkeypatch.setattr(correction, "_MOST_STEPS", 7)
    assert count_new_views(monkeypatch, 64) == (5, 7)


@pytest.mark.parametrize("end", [KeyboardInterrupt, ValueError])
def test_a_fit_that_is_ended_early_leaves_the_network_as_it_was(end: type[BaseException]) -> None:
    def stop_at(half: float) -> Callable[[float], None]:
        def stop(share: float) -> None:
            if share > half:
                raise end

        return stop

    made = network()
    with pytest.raises(end):
        fit_correction(made, some_queries(100, 4), LearningSettings(low_batch=16), 0, 2, steps=20, follow=stop_at(0.5))
    assert made.correction is None
    assert made.settings == network().settings


def test_few_queries_are_a_batch() -> None:
    made = NeuralBSSRDF(SETTINGS, interior=glass_ball(1.4))
    fit_correction(made, some_queries(5, 5), LearningSettings(low_batch=512), 0, 0, steps=30)
    assert made.correction is not None
