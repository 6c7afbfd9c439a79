"""The shared error of networks is separated from random errors and from the reference's noise."""

import runpy
from pathlib import Path

import numpy as np
import pytest

from prt_bake.trainer.validation import HeldOutCoefficients

SCRIPT = Path(__file__).parent / "shared_error.py"


def test_the_shared_error_is_found_below_the_reference_s_noise() -> None:
    """Errors are 7 % shared and 5 % separate, the reference's noise is 10 %: shared 7 %, total √(7² + 5²) %."""
    generator = np.random.default_rng(0)
    shape = 2000, 9, 3
    truth = generator.normal(size=shape)
    noise = np.full(shape, 0.1)
    measured = HeldOutCoefficients(truth, truth, truth + noise * generator.normal(size=shape), noise, 1)
    common = truth + 0.07 * generator.normal(size=shape)
    first, second = (common + 0.05 * generator.normal(size=shape) for _ in range(2))
    shared = runpy.run_path(str(SCRIPT))["shared"]
    both, both_error = shared(first, second, measured)
    one, one_error = shared(first, first, measured)
    assert both == pytest.approx(7.0, abs=4.0 * both_error)
    assert one == pytest.approx(100.0 * np.hypot(0.07, 0.05), abs=4.0 * one_error)
    assert max(both_error, one_error) < 0.1
