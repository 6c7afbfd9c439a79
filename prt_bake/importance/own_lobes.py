"""Sampling of incident directions by the lobes that a network has itself: a mixture of Gaussians for each point."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from prt_bake.mathematics.lobe import SIGMAS, Lobe

Array = NDArray[np.float64]

_GAUSSIAN = 2.0
"""The shape of a `Lobe` that falls off as a Gaussian."""


class OwnLobes:
    """The lobes of a network, drawn by their power: an importance module without a fit.

    >>> import prt_bake as prt
    >>> lobes = own_lobes(prt.load_model("grape.pt"))
    """

    def __init__(self, network: Any) -> None:
        """network: offers own_lobes, and has some (`prt_bake.NeuralBSSRDF.own_lobes`)."""
        self._network = network

    def lobe(self, positions: Array, outgoing: Array, normals: Array) -> Lobe:
        """The lobes at positions [N,3] seen along outgoing [N,3]; normals are not used."""
        axes, sharpness, powers = self._network.own_lobes(positions, outgoing)
        weights = np.abs(powers).sum(axis=2) + np.finfo(np.float64).tiny
        sigma = np.clip(1.0 / np.sqrt(sharpness), *SIGMAS)
        return Lobe(axes, sigma, weights / weights.sum(axis=1, keepdims=True), _GAUSSIAN)


def own_lobes(network: Any) -> OwnLobes | None:
    """The sampling by a network's own lobes; None if it has none."""
    return OwnLobes(network) if getattr(getattr(network, "settings", None), "lobes", 0) else None
