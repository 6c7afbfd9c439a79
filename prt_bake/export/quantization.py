"""The engine form in 8 bits, normalised integers with one scale for each pair of harmonics and channel; in halves."""

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from formats.errors import QueryError
from prt_bake.export.engine_form import EngineForm

LARGEST = 127
LARGEST_HALF = float(np.finfo(np.float16).max)


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


def in_halves(form: EngineForm) -> EngineForm:
    """The form with its coefficients rounded to half floats. Raises QueryError for one that no half float holds."""
    largest = float(np.abs(form.coefficients).max())
    if not largest <= LARGEST_HALF:
        raise QueryError(
            f"asset: a coefficient is {largest:.4g}, half floats end at {LARGEST_HALF:,.0f}; export it as X.glb, which "
            "has 32 bits"
        )
    return dataclasses.replace(form, coefficients=form.coefficients.astype(np.float16).astype(np.float32))
