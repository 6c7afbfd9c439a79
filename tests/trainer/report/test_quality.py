"""The quality of a model: its error in words, and what more training would bring."""

import math

import pytest

from prt_bake.mathematics.noise_free import Interval
from prt_bake.trainer.report.quality import LEVELS, learning_minutes, quality


@pytest.mark.parametrize(("error", "words"), [(0.04, LEVELS[0][1]), (0.09, LEVELS[1][1]), (0.15, LEVELS[2][1])])
def test_an_error_has_a_use(error: float, words: str) -> None:
    text = quality(Interval(error, 0.9 * error, 1.1 * error), 5.0, 1e6)
    assert text.startswith(f"the network is {100 * error:.1f} % off ({90 * error:.1f} to {110 * error:.1f}): {words}; ")


def test_a_wide_interval_leaves_doubt() -> None:
    text = quality(Interval(0.088, 0.0, 0.17), 2.0, 1e6)
    assert "(0.0 to 17.0): good for previews and real-time use (at the upper end of this range only good for a " in text
    text = quality(Interval(0.15, 0.1, 0.3), 2.0, 1e6)
    assert "good for a first look (at the upper end of this range only a rough impression); " in text
    assert "upper end" not in quality(Interval(0.4, 0.3, 0.5), 2.0, 1e6)


def test_more_time_brings_less_the_longer_a_training_was() -> None:
    """By the exponents measured."""
    assert "ten minutes more would bring about 7 % (extrapolated)" in quality(Interval(0.107, 0.1, 0.11), 2.0, 5.8e6)
    assert "ten minutes more would bring about 9 % (extrapolated)" in quality(Interval(0.1, 0.09, 0.11), 10.0, 3e7)
    assert "about 10 %" in quality(Interval(0.169, 0.15, 0.18), 0.6, 1e6)
    assert "twice the time would bring about 18 % (extrapolated)" in quality(Interval(0.2, 0.19, 0.21), 60.0, 1e9)
    assert "more would" not in quality(Interval(0.1, 0.09, 0.11), 0.0, 0.0)


def test_a_model_at_the_ceiling_of_its_class_is_not_extrapolated() -> None:
    text = quality(Interval(0.56, 0.5, 0.6), 2.0, 5.8e6, "nerfactor")
    assert text.endswith(
        "a rough impression; more training would bring little: no BRDF has the light that comes through the object"
    )
    assert "extrapolated" in quality(Interval(0.56, 0.5, 0.6), 2.0, 5.8e6, "neumip")


def test_a_baseline_is_a_model_and_not_a_network() -> None:
    nan, error = math.nan, Interval(0.3, 0.2, 0.4)
    for kind, name in (("neumip", "model"), ("nerfactor", "model"), ("neural bssrdf", "network")):
        assert quality(error, 1.0, 1e6, kind).startswith(f"the {name} is 30.0 % off")
        assert quality(Interval(nan, nan, nan), 1.0, 1e6, kind).startswith(f"the error of the {name} is unknown")


def test_an_unknown_error_or_interval_is_no_number() -> None:
    nan = math.nan
    assert "unknown" in quality(Interval(nan, nan, nan), 1.0, 1e6)
    assert quality(Interval(0.3, nan, nan), 1.0, 1e6).startswith("the network is 30.0 % off: a rough impression; ")
    for hidden in (Interval(0.04, 0.0, 0.04), Interval(0.0, 0.0, 0.04)):
        text = "the network is at most 4.0 % off (0.0 to 4.0): good for final pictures"
        assert quality(hidden, 5.0, 1e6) == text
    assert quality(Interval(0.0, 0.0, 0.0), 0.0, 1e6).startswith("the network is 0.0 % off")


def test_nothing_is_extrapolated_from_a_part_of_the_learning() -> None:
    assert learning_minutes(120.0, "") == 2.0
    assert learning_minutes(120.0, "wax.toml, 900 steps") == 0.0
