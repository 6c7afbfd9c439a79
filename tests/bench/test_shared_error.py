"""What networks of one scene have in common is told from chance and from the reference's noise."""

import runpy
from pathlib import Path

import numpy as np
import pytest

from prt_bake.trainer.validation import HeldOutCoefficients

SCRIPT = Path(__file__).parent / "shared_error.py"


def test_what_is_shared_of_two_errors_is_found_beneath_a_noisier_reference() -> None:
    """The errors are 7 % in common and 5 % each, the reference's noise is 10 %: shared 7 %, together √(7² + 5²) %."""
    generator = np.random.default_rng(0)
    shape = 2000, 9, 3
    truth = generator.normal(size=shape)
    noise = np.full(shape, 0.1)
    measured = HeldOutCoefficients(truth, truth, truth + noise * generator.normal(size=shape), noise, 1)
    common = truth + 0.07 * generator.normal(size=shape)
    first, second = (common + 0.05 * generator.normal(size=shape) for _ in range(2))
    shared = runpy.run_path(str(SCRIPT))["shared"]
    of_both, its_error = shared(first, second, measured)
    of_one, one_error = shared(first, first, measured)
    assert of_both == pytest.approx(7.0, abs=4.0 * its_error)
    assert of_one == pytest.approx(100.0 * np.hypot(0.07, 0.05), abs=4.0 * one_error)
    assert max(its_error, one_error) < 0.1
