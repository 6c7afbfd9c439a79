"""Error of coefficients that are fitted to Ŝ in D directions, estimated from the residuals of the fit.

The residual shows how rough Ŝ is at a bin, and its ratio to the true error hardly varies between the bins of one object
(measured on six trained networks: correlation 0.86–0.98 of the logarithms over bins, a scatter of 20–40 %). The
textbook's error, which assumes independent residuals, is 1.5 to 14 times too large: a lattice is more accurate than
that, increasingly so with more directions. The ratio is measured for each bake.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

PRIOR_BINS = 8.0
"""Weight of the prior, in measured bins."""
DEFAULT_GAIN, DEFAULT_SLOPE = 3.0, 0.7
DEFAULT_OF_DIFFERENCES = 4.0
REFERENCE_SIZE = 64.0
SLOPES = 0.3, 2.0
GAINS = np.log(0.01), np.log(1e4)
"""Bounds on the logarithm of a single bin's squared gain over the default."""
MOST_LOG_VARIANCE = 1.0
"""Largest variance of the logarithms that is used: half of it is the difference between their mean and the logarithm of
the mean.
"""
EXTRAPOLATED_SIZE = 512
"""Largest size up to which the measured power law is extrapolated; beyond, gains grow no faster than by default."""


@dataclass(frozen=True)
class LatticeNoise:
    """error = residual · sqrt(share) / gain, gain = gain at 64 directions · (D/64)^slope."""

    gain: float = DEFAULT_GAIN
    slope: float = DEFAULT_SLOPE
    of_differences: float = DEFAULT_OF_DIFFERENCES
    """Ratio of the variance of a difference from its prediction to that of Ŝ itself with the same residual. A
    difference has finer detail, on which a lattice gains less.
    """

    def variance(self, share: float, size: int) -> float:
        """Variance of a coefficient (mean over K) over the residual variance, for a fit over `size` directions.

        `share` is this ratio if the residuals are independent.
        """
        extrapolated = min(size, EXTRAPOLATED_SIZE)
        gain = (
            self.gain
            * (extrapolated / REFERENCE_SIZE) ** self.slope
            * (size / extrapolated) ** min(self.slope, DEFAULT_SLOPE)
        )
        return float(share / gain**2)


def fit_lattice_noise(
    shares: Sequence[float], sizes: tuple[int, ...], residual_variance: Array, squared: Array
) -> LatticeNoise:
    """Fits the noise model to squared errors [P,M] (mean over K and channels) and residual variances [P,M] of M bins
    with P sizes, with variance shares `shares` [P]. With few bins or hardly any noise the default remains.
    """
    logs = []
    for share_of_values, size, r, e in zip(shares, sizes, residual_variance, squared, strict=True):
        default = 2.0 * np.log(DEFAULT_GAIN * (size / REFERENCE_SIZE) ** DEFAULT_SLOPE)
        positive = (r > 0.0) & (e > 0.0)
        # The gain of single bins varies by a factor of two or more; a sum would be dominated by one or two bins.
        each = np.clip(np.log(share_of_values * r[positive] / e[positive]) - default, *GAINS) + default
        mean = float(each.mean() - min(each.var(), MOST_LOG_VARIANCE) / 2.0) if positive.any() else default
        share = PRIOR_BINS / (PRIOR_BINS + int(positive.sum()))
        logs.append(0.5 * (share * default + (1.0 - share) * mean))
    across = np.log(np.array(sizes) / REFERENCE_SIZE)
    slope = float(np.clip(np.polyfit(across, logs, 1)[0], *SLOPES)) if len(logs) > 1 else DEFAULT_SLOPE
    return LatticeNoise(float(np.exp(np.mean(logs) - slope * np.mean(across))), slope)
