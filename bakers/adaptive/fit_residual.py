"""How far off coefficients are that were fitted to Ŝ in D directions: from what the fit leaves over.

The residual of the fit tells how rough Ŝ is at that bin, and its relation to the true error hardly differs from bin to
bin of one object (measured on six trained networks: correlation 0.86–0.98 of the logarithms over bins, a scatter of
20–40 %), though the textbook's error, as if residuals were independent, is 1.5 to 14 times too large: a lattice does
better than that, and the more so the more directions it has. That ratio is measured where the bake is.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BEFORE = 8.0
"""How many measured bins weigh as much as what is believed beforehand."""
USUAL_GAIN, USUAL_SLOPE = 3.0, 0.7
USUAL_OF_DIFFERENCES = 4.0
AT = 64.0
SLOPES = 0.3, 2.0
GAINS = np.log(0.01), np.log(1e4)
"""Squared gains over the usual one, in logarithms, between which those of single bins are taken."""
WIDEST = 1.0
"""Variance of the logarithms that is believed: half of it lies between their mean and the logarithm of the mean."""
SEEN = 512
"""Directions up to which the law that was seen with fewer is carried on; beyond, gains grow no faster than usual."""


@dataclass(frozen=True)
class LightNoise:
    """error = roughness · sqrt(share) / gain, gain = gain at 64 directions · (D/64)^slope."""

    gain: float = USUAL_GAIN
    slope: float = USUAL_SLOPE
    of_differences: float = USUAL_OF_DIFFERENCES
    """How many times more variance a difference to what was foretold has than Ŝ itself of the same roughness: it is
    made of finer detail, which a lattice does not gain as much on.
    """

    def variance(self, share: float, size: int) -> float:
        """Variance of a coefficient (mean over K) per squared roughness, fitted over so many directions; `share` is
        what it would be if values had independent errors.
        """
        seen = min(size, SEEN)
        gain = self.gain * (seen / AT) ** self.slope * (size / seen) ** min(self.slope, USUAL_SLOPE)
        return float(share / gain**2)


def fitted_noise(shares: Sequence[float], sizes: tuple[int, ...], rough: Array, squared: Array) -> LightNoise:
    """The noise that was seen: squared errors [P,M] (mean over K and channels) of M bins with each of P sizes, whose
    variance shares these are, and their squared roughness [P,M]. Few bins, or hardly any noise, leave what is usual.
    """
    logs = []
    for share_of_values, size, r, e in zip(shares, sizes, rough, squared, strict=True):
        usual = 2.0 * np.log(USUAL_GAIN * (size / AT) ** USUAL_SLOPE)
        seen = (r > 0.0) & (e > 0.0)
        # The gain of single bins scatters by a factor of two or more: a sum would be that of one bin or two.
        each = np.clip(np.log(share_of_values * r[seen] / e[seen]) - usual, *GAINS) + usual
        mean = float(each.mean() - min(each.var(), WIDEST) / 2.0) if seen.any() else usual
        share = BEFORE / (BEFORE + int(seen.sum()))
        logs.append(0.5 * (share * usual + (1.0 - share) * mean))
    across = np.log(np.array(sizes) / AT)
    slope = float(np.clip(np.polyfit(across, logs, 1)[0], *SLOPES)) if len(logs) > 1 else USUAL_SLOPE
    return LightNoise(float(np.exp(np.mean(logs) - slope * np.mean(across))), slope)
