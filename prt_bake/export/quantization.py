"""The engine form in 8 bits, normalised integers with one scale for each pair of harmonics and channel; in halves."""

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from formats.errors import QueryError, warn
from prt_bake.export.engine_form import EngineForm

LARGEST = 127
LARGEST_HALF = float(np.finfo(np.float16).max)
_LARGE = 0.02
"""Relative RMSE of 8 bits alone at the median vertex from which on a warning says so; baked objects have 0.004 to 0.01,
and one vertex that is ten times as bright as the others causes 0.02 to 0.03."""
_BRIGHT = 5.0
"""Largest coefficient, compared with that of the median vertex, of a vertex that the warning names."""


class Quantized(NamedTuple):
    """codes int8 [V,R,K,3] and scales float32 [R,K,3]: a coefficient is code / 127 · scale."""

    codes: NDArray[np.int8]
    scales: NDArray[np.float32]


def quantized(form: EngineForm) -> Quantized:
    """Round the coefficients of a form to 8 bits."""
    scales = np.abs(form.coefficients).max(axis=0)
    codes = np.round(form.coefficients / np.where(scales > 0.0, scales, 1.0) * LARGEST).astype(np.int8)
    return Quantized(codes, scales)


def dequantized(form: EngineForm, stored: Quantized) -> EngineForm:
    """The form with the coefficients that a reader finds."""
    read = stored.codes.astype(np.float32) / np.float32(LARGEST) * stored.scales
    return dataclasses.replace(form, coefficients=read)


def warn_of_bright_vertices(form: EngineForm, read: EngineForm) -> None:
    """Issue an InputWarning if 8 bits alone make an error at most vertices: a few set the scales of all.

    read: the form that a reader finds.
    """
    sizes = np.abs(form.coefficients).max(axis=(1, 2, 3), initial=0.0)
    lit = np.flatnonzero(sizes)
    if not len(lit):
        return
    before, after = form.coefficients[lit].astype(np.float64), read.coefficients[lit]
    errors = np.sqrt(((after - before) ** 2).sum(axis=(1, 2, 3)) / (before**2).sum(axis=(1, 2, 3)))
    off, median = float(np.median(errors)), float(np.median(sizes[lit]))
    if off < _LARGE:
        return
    brightest = lit[np.argsort(-sizes[lit], kind="stable")]
    count = max(1, int((sizes[lit] > _BRIGHT * median).sum()))
    numbers = ", ".join(map(str, brightest[: min(count, 3)])) + (", …" if count > 3 else "")
    warn(
        f"quantize: 8 bits alone are {off:.1%} off at the median vertex, since each scale is that of the brightest "
        f"vertex: {'vertex' if count == 1 else f'{count:,} vertices'} {numbers} with up to "
        f"{sizes[brightest[0]] / median:,.0f} times the median coefficients; export without --quantize"
    )


def in_halves(form: EngineForm) -> EngineForm:
    """The form with its coefficients rounded to half floats. Raises QueryError for one that no half float holds."""
    largest = float(np.abs(form.coefficients).max())
    if not largest <= LARGEST_HALF:
        raise QueryError(
            f"asset: a coefficient is {largest:.4g}, half floats end at {LARGEST_HALF:,.0f}; export it as X.glb, which "
            "has 32 bits"
        )
    return dataclasses.replace(form, coefficients=form.coefficients.astype(np.float16).astype(np.float32))
