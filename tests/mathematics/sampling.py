"""Statistical tests of samplers: chi-square for counts in cells, z-tests for means.

With a random seed each single test would fail a correct sampler with probability FALSE_ALARM.
"""

import math

import numpy as np
import pytest
from scipy.stats import chi2, norm

FALSE_ALARM = 1e-6
Z_BOUND = norm.isf(FALSE_ALARM / 2)
LEAST_EXPECTED = 10
SAMPLES = 200_000


def assert_counts_follow(counts, probabilities):
    """Chi-square test of counts against probabilities that sum to 1; cells with too few expected counts are merged."""
    assert probabilities.sum() == pytest.approx(1.0, abs=1e-4)
    assert counts[probabilities == 0.0].sum() == 0
    expected = counts.sum() * probabilities
    large = expected >= LEAST_EXPECTED
    rest_expected = expected[~large].sum()
    observed, expected = counts[large], expected[large]
    if rest_expected >= LEAST_EXPECTED:
        observed, expected = np.append(observed, counts[~large].sum()), np.append(expected, rest_expected)
    assert len(observed) >= 8
    statistic = ((observed - expected) ** 2 / expected).sum()
    assert statistic < chi2.isf(FALSE_ALARM, len(observed) - 1)


def assert_mean_is(values, expected):
    error = values.std(ddof=1) / math.sqrt(len(values))
    assert abs(values.mean() - expected) < Z_BOUND * error


class SphereCells:
    """Cells of the sphere by rings of equal height and sectors: counts, and integrals by 4×4 Gauss points per cell."""

    def __init__(self, rings, sectors):
        self.rings, self.sectors = rings, sectors
        nodes, weights = np.polynomial.legendre.leggauss(4)
        z = (2 * (np.arange(rings)[:, None] + 0.5 * (nodes + 1)) / rings - 1).ravel()
        phi = (2 * np.pi * (np.arange(sectors)[:, None] + 0.5 * (nodes + 1)) / sectors).ravel()
        sine = np.sqrt(1 - z**2)[:, None]
        x, y = sine * np.cos(phi), sine * np.sin(phi)
        self.directions = np.stack([x, y, np.broadcast_to(z[:, None], x.shape)], axis=-1).reshape(-1, 3)
        self.point_weights = np.outer(weights, weights) * np.pi / (rings * sectors)

    def integrate(self, values):
        """Integral over each cell [cells]."""
        table = values.reshape(self.rings, 4, self.sectors, 4)
        return np.einsum("iajb,ab->ij", table, self.point_weights).ravel()

    def count(self, directions):
        """Directions in each cell [cells]."""
        ring = np.minimum((0.5 * (directions[:, 2] + 1) * self.rings).astype(int), self.rings - 1)
        turn = np.arctan2(directions[:, 1], directions[:, 0]) / (2 * np.pi) % 1.0
        sector = np.minimum((turn * self.sectors).astype(int), self.sectors - 1)
        return np.bincount(ring * self.sectors + sector, minlength=self.rings * self.sectors)
