"""Significance thresholds with a stated false-alarm rate."""

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

FALSE_ALARM = 1e-4
"""Probability that a test fails by chance after a change of its seed, unless stated otherwise."""


def largest_z(count: int, false_alarm: float = FALSE_ALARM) -> float:
    """Bound of the largest |z| of `count` normal figures, dependent or not (Bonferroni)."""
    return float(stats.norm.isf(0.5 * false_alarm / count))


def z_scores(a: ArrayLike, a_error: ArrayLike, b: ArrayLike, b_error: ArrayLike = 0.0) -> np.ndarray:
    """(a − b) in standard errors; 0 where both are equal and neither has an error."""
    difference, error = np.asarray(a) - np.asarray(b), np.hypot(a_error, b_error)
    error = np.broadcast_to(error, difference.shape)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(difference == 0.0, 0.0, difference / error)


def assert_agree(a: ArrayLike, a_error: ArrayLike, b: ArrayLike, b_error: ArrayLike = 0.0) -> None:
    """Assert that all figures of `a` agree with `b` within both errors, at FALSE_ALARM for all of them together."""
    z = z_scores(a, a_error, b, b_error)
    limit = largest_z(z.size)
    worst = np.unravel_index(np.argmax(np.abs(z)), z.shape)
    assert np.abs(z).max() < limit, (
        f"z = {z[worst]:.2f} at {tuple(int(i) for i in worst)}, limit {limit:.2f}: {np.asarray(a)[worst]} and "
        f"{np.broadcast_to(b, z.shape)[worst]}"
    )
