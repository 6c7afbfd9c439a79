"""FLIP and HDR-FLIP, maps of the difference that one sees when two pictures are shown in turn.

FLIP (Andersson et al., "FLIP: A difference evaluator for alternating images", 2020) is of pictures as they are shown.
HDR-FLIP (Andersson et al., "Visualizing errors in rendered high dynamic range images", Eurographics 2021) is the
largest FLIP of a pixel over a range of exposures, each shown through the ACES curve: no highlight and no shadow hides.

flip-evaluator computes both. The range of exposures is own code: the library's goes up to 24 stops where half of the
reference is black, as in pictures without a background.
"""

import math
import os
import sys
from importlib import import_module
from types import ModuleType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from formats.errors import PrtbakeError, QueryError

Array = NDArray[np.float64]

PIXELS_PER_DEGREE = 67.0
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
_SHOWN_AS = 0.85
"""What the ACES curve gives for the brightest pixel at the first exposure and for the median one at the last."""
_ACES = (0.9036, 0.018, 0.0, 0.8748, 0.354, 0.14)
"""(a x² + b x + c) / (d x² + e x + f), Narkowicz's fit, x scaled by 0.6 first."""
_MOST_STOPS = 128.0
_LARGEST = 1e15
"""Of radiance at the last exposure: white long before, and its square fits float32."""


class Exposures(NamedTuple):
    """The stops that HDR-FLIP looks at: `steps` of them from `start` to `stop`, both included."""

    start: float
    stop: float
    steps: int


def flip_map(image: Array, reference: Array) -> NDArray[np.float32]:
    """FLIP [H,W] of pictures [H,W,3] as they are shown, sRGB in [0,1], at 67 pixels a degree; 0 equal, 1 the worst.

    Raises PrtbakeError where the extra `evaluate` is not installed.
    """
    return _evaluated(image, reference, "LDR", {})


def hdr_flip_map(image: Array, reference: Array, exposures: Exposures) -> NDArray[np.float32]:
    """HDR-FLIP [H,W] of linear pictures [H,W,3]; what is negative is taken as black, as displays show it.

    Raises as `flip_map`.
    """
    start, stop, steps = exposures
    largest = _LARGEST * 2.0 ** -max(stop, 0.0)
    ours, theirs = (np.clip(part, 0.0, largest) for part in (image, reference))
    return _evaluated(ours, theirs, "HDR", {"startExposure": start, "stopExposure": stop, "numExposures": steps})


def paper_exposures(reference: Array) -> Exposures:
    """The range that the paper of HDR-FLIP takes for a linear reference [H,W,3], about a stop apart.

    From where its largest luminance is shown as 0.85 by the ACES curve to where its median luminance is. Black pixels
    are left out of the median if they are half of the picture or more: the paper's range would not end. A black
    reference is looked at as it is.
    """
    luminance = np.maximum(reference, 0.0) @ _LUMINANCE
    largest, median = float(luminance.max()), float(np.median(luminance))
    if not largest > 0.0:
        return Exposures(0.0, 0.0, 2)
    if not median > 0.0:
        median = float(np.median(luminance[luminance > 0.0]))
    shown = _radiance_shown_as(_SHOWN_AS)
    start, stop = (float(np.clip(math.log2(shown / y), -_MOST_STOPS, _MOST_STOPS)) for y in (largest, median))
    return exposures_between(start, stop)


def exposures_between(start: float, stop: float) -> Exposures:
    """As many exposures as the paper takes between two: a stop apart, both ends included.

    Raises QueryError where `start` is above `stop`, or one of them beyond ±128 stops.
    """
    if not (-_MOST_STOPS <= start <= stop <= _MOST_STOPS):
        raise QueryError(
            f"compare: exposures from {start:g} to {stop:g} where a range within ±{_MOST_STOPS:g} stops is expected, "
            "the lower end first"
        )
    # The library looks at none where it is asked for one.
    return Exposures(start, stop, max(2, math.ceil(stop - start)))


def evaluate_extra(name: str) -> ModuleType:
    """A module of the extra `evaluate`; raises PrtbakeError where it is not installed."""
    try:
        return import_module(name)
    except ImportError:
        package = name.partition(".")[0]
        raise PrtbakeError(
            f"compare: {package} is not installed; install the extra that brings it: pip install 'prt-bake[evaluate]'"
        ) from None


def _radiance_shown_as(level: float) -> float:
    a, b, c, d, e, f = _ACES
    square, linear, constant = a - level * d, b - level * e, c - level * f
    return (-linear + math.sqrt(linear**2 - 4.0 * square * constant)) / (2.0 * square)


def _flip_evaluator() -> ModuleType:
    """The library, whose threads wait for one another asleep: spinning, as OpenMP has it where nobody says otherwise,
    takes six times as long where others keep the cores busy. It is read once, while the library is loaded.
    """
    policy = "OMP_WAIT_POLICY"
    if policy in os.environ or "flip_evaluator" in sys.modules:
        return evaluate_extra("flip_evaluator")
    os.environ[policy] = "passive"
    try:
        return evaluate_extra("flip_evaluator")
    finally:
        del os.environ[policy]


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
