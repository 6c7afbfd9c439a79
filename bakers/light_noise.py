"""How far off coefficients are that were fitted to Ŝ in D directions: from what the fit leaves over.

The residual of the fit tells how rough Ŝ is at that bin, and its relation to the true error hardly differs from bin to
bin of one object (measured on six trained networks: correlation 0.86–0.98 of the logarithms over bins, a scatter of
20–40 %), though the textbook's error, as if residuals were independent, is 1.5 to 14 times too large: a lattice does
better than that, and the more so the more directions it has. That ratio is measured where the bake is.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bakers.nested_lattice import NestedLattice

Array = NDArray[np.float64]

BEFORE = 8.0
"""How many measured bins weigh as much as what is believed beforehand."""
USUAL_GAIN, USUAL_SLOPE = 3.0, 0.7
USUAL_OF_DIFFERENCES = 4.0
AT = 64.0


@dataclass(frozen=True)
class LightNoise:
    """error = roughness · sqrt(share) / gain, gain = gain at 64 directions · (D/64)^slope."""

    gain: float = USUAL_GAIN
    slope: float = USUAL_SLOPE
    of_differences: float = USUAL_OF_DIFFERENCES
    """How many times more variance a difference to what was foretold has than Ŝ itself of the same roughness: it is
    made of finer detail, which a lattice does not gain as much on.
    """

    def variance(self, lattice: NestedLattice, size: int) -> float:
        """Variance of a fitted coefficient (mean over K) per squared roughness."""
        share = lattice.variance_shares[lattice.sizes.index(size)]
        return float(share / (self.gain * (size / AT) ** self.slope) ** 2)


def fitted_noise(lattice: NestedLattice, sizes: tuple[int, ...], rough: Array, squared: Array) -> LightNoise:
    """The noise that was seen: squared errors [P,M] (mean over K and channels) of M bins with each of P sizes of the
    lattice, and their squared roughness [P,M]. Few bins, or hardly any noise, leave what is usual.
    """
    logs = []
    for size, r, e in zip(sizes, rough, squared, strict=True):
        usual = (USUAL_GAIN * (size / AT) ** USUAL_SLOPE) ** 2
        textbook = float(r.sum()) * lattice.variance_shares[lattice.sizes.index(size)]
        seen = textbook / float(e.sum()) if textbook > 0 and e.sum() > 0 else usual
        share = BEFORE / (BEFORE + len(r))
        logs.append(0.5 * (share * np.log(usual) + (1.0 - share) * np.log(np.clip(seen, 0.01 * usual, 1e4 * usual))))
    across = np.log(np.array(sizes) / AT)
    slope = float(np.clip(np.polyfit(across, logs, 1)[0], 0.3, 1.5)) if len(logs) > 1 else USUAL_SLOPE
    return LightNoise(float(np.exp(np.mean(logs) - slope * np.mean(across))), slope)
