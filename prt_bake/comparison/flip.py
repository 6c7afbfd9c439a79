"""FLIP and HDR-FLIP: maps of the perceived difference between two pictures that alternate in place.

FLIP (Andersson et al., "FLIP: A difference evaluator for alternating images", 2020) compares display-referred pictures.
HDR-FLIP (Andersson et al., "Visualizing errors in rendered high dynamic range images", Eurographics 2021) is the
largest FLIP of a pixel over a range of exposures, tone mapped by the ACES curve.

flip-evaluator computes both. The range of exposures is computed here, because the library's range extends to 24 stops
if half of the reference is black, as in pictures without a background.
"""

import math
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from types import ModuleType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from formats.errors import QueryError
from formats.extras import require
from formats.image.gamut import LUMINANCE

Array = NDArray[np.float64]

PIXELS_PER_DEGREE = 67.0
_TONE_MAPPED = 0.85
"""Tone-mapped value of the brightest pixel at the first exposure, and of the median pixel at the last."""
_ACES = (0.9036, 0.018, 0.0, 0.8748, 0.354, 0.14)
"""(a x² + b x + c) / (d x² + e x + f), Narkowicz's fit, including the scale of x by 0.6."""
_MAX_STOPS = 128.0
_MAX_RADIANCE = 1e15
"""At the last exposure: far beyond white, and its square fits float32."""


class Exposures(NamedTuple):
    """The exposures of HDR-FLIP: `steps` stops from `start` to `stop`, both included."""

    start: float
    stop: float
    steps: int


def flip_map(image: Array, reference: Array) -> NDArray[np.float32]:
    """FLIP [H,W] of sRGB pictures [H,W,3] in [0,1], at 67 pixels per degree; 0 is equal, 1 the worst.

    Raises PrtbakeError if the extra `evaluate` is not installed.
    """
    return _evaluated(image, reference, "LDR", {})


def hdr_flip_map(image: Array, reference: Array, exposures: Exposures) -> NDArray[np.float32]:
    """HDR-FLIP [H,W] of linear pictures [H,W,3]; negative values count as black. Raises as `flip_map`."""
    start, stop, steps = exposures
    largest = min(_MAX_RADIANCE * 2.0**-stop, float(np.finfo(np.float32).max))
    ours, theirs = (np.clip(part, 0.0, largest) for part in (image, reference))
    return _evaluated(ours, theirs, "HDR", {"startExposure": start, "stopExposure": stop, "numExposures": steps})


def paper_exposures(reference: Array) -> Exposures:
    """The range of the HDR-FLIP paper for a linear reference [H,W,3], about a stop apart.

    At the first exposure the largest luminance is tone mapped to 0.85, at the last one the median luminance. The median
    excludes black pixels if they are half of the picture or more, for which the paper's range is infinite. A black
    reference has the range 0 to 0.
    """
    luminance = np.maximum(reference, 0.0) @ LUMINANCE
    largest, median = float(luminance.max()), float(np.median(luminance))
    if not largest > 0.0:
        return Exposures(0.0, 0.0, 2)
    if not median > 0.0:
        median = float(np.median(luminance[luminance > 0.0]))
    target = _inverse_aces(_TONE_MAPPED)
    start, stop = (float(np.clip(math.log2(target / y), -_MAX_STOPS, _MAX_STOPS)) for y in (largest, median))
    return exposures_between(start, stop)


def exposures_between(start: float, stop: float) -> Exposures:
    """Exposures about a stop apart, both ends included, as in the paper.

    Raises QueryError if `start` is above `stop`, or if one of them is beyond ±128 stops.
    """
    if not (-_MAX_STOPS <= start <= stop <= _MAX_STOPS):
        raise QueryError(
            f"compare: expected a range of exposures within ±{_MAX_STOPS:g} stops, the lower end first, found "
            f"{start:g} to {stop:g}"
        )
    # For one exposure the library computes none.
    return Exposures(start, stop, max(2, math.ceil(stop - start)))


def evaluate_extra(name: str) -> ModuleType:
    """A module of the extra `evaluate`. Raises PrtbakeError if it is not installed."""
    require("compare", name.partition(".")[0])
    return import_module(name)


def _inverse_aces(level: float) -> float:
    """The radiance that the ACES curve maps to `level`."""
    a, b, c, d, e, f = _ACES
    square, linear, constant = a - level * d, b - level * e, c - level * f
    return (-linear + math.sqrt(linear**2 - 4.0 * square * constant)) / (2.0 * square)


def _flip_evaluator() -> ModuleType:
    """The library, loaded with OpenMP threads that sleep while they wait.

    OpenMP's default, spinning, takes many times as long on a busy machine. OpenMP reads the policy once, on loading.
    If torch was loaded before, it offers its own OpenMP to all libraries; this one is bound to the copy that it brings.
    """
    policy = "OMP_WAIT_POLICY"
    if policy in os.environ or "flip_evaluator" in sys.modules:
        return evaluate_extra("flip_evaluator")
    os.environ[policy] = "passive"
    try:
        with _own_libraries_first():
            return evaluate_extra("flip_evaluator")
    finally:
        del os.environ[policy]


@contextmanager
def _own_libraries_first() -> Iterator[None]:
    """Within, a compiled module is bound to the libraries that it brings before those that others offer (Linux)."""
    if not hasattr(os, "RTLD_DEEPBIND"):
        yield
        return
    flags = sys.getdlopenflags()
    sys.setdlopenflags(flags | os.RTLD_DEEPBIND)
    try:
        yield
    finally:
        sys.setdlopenflags(flags)


def _evaluated(image: Array, reference: Array, kind: str, parameters: dict[str, float]) -> NDArray[np.float32]:
    errors, _mean, _parameters = _flip_evaluator().evaluate(
        np.ascontiguousarray(reference, np.float32),
        np.ascontiguousarray(image, np.float32),
        kind,
        applyMagma=False,
        computeMeanError=False,
        parameters={"ppd": PIXELS_PER_DEGREE, **parameters},
    )
    return np.asarray(errors, np.float32).reshape(reference.shape[:2])
