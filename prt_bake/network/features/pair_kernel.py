"""Compiled Fourier features of views and incident directions.

The phases of x and ωo are given per view, in cycles; that of ωi is added for each direction. After reduction to half a
cycle, short polynomials give sine and cosine to float32 rounding, in a tenth of the time of the general functions.
"""

from typing import Any

import numpy as np

from prt_bake.jit.compilation import compiled

# Minimax polynomials of sin(2πr) in odd powers of r and of cos(2πr) in even ones, |r| ≤ 1/2: errors of 2e-9 and 1e-8.
_S = tuple(
    np.float32(c)
    for c in (6.283185302, -41.34170039, 81.60513081, -76.70300556, 42.02585149, -14.89957844, 3.237780093)
)
_C = tuple(
    np.float32(c)
    for c in (0.9999999889, -19.73920447, 64.93911593, -85.45011343, 60.16742979, -25.96688461, 6.527705963)
)
_S0, _S1, _S2, _S3, _S4, _S5, _S6 = _S
_C0, _C1, _C2, _C3, _C4, _C5, _C6 = _C
_HALF = np.float32(0.5)


@compiled(nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def cos_sin(cycles: Any) -> Any:
    """Cosine and sine of an angle in float32 cycles."""
    r = cycles - np.floor(cycles + _HALF)
    t = r * r
    cosine = _C0 + t * (_C1 + t * (_C2 + t * (_C3 + t * (_C4 + t * (_C5 + t * _C6)))))
    return cosine, r * (_S0 + t * (_S1 + t * (_S2 + t * (_S3 + t * (_S4 + t * (_S5 + t * _S6))))))


@compiled(nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def fourier_rows(view: Any, along: Any, common: Any, deviation: Any, rows: Any) -> None:
    """Fills row n·S + s of rows [N·S, 2F] with [cosines, sines] of view n and its direction s.

    All float32: view [N,F], cycles of position and outgoing direction; along [N,S,3], the encoded incident direction;
    common [N,S], its cycles due to the mean of the frequencies; deviation [3,F], the frequencies less their mean.
    """
    features = view.shape[1]
    directions = along.shape[1]
    g, h, k = deviation[0], deviation[1], deviation[2]
    for n in range(view.shape[0]):
        view_cycles = view[n]
        for s in range(directions):
            x, y, z, shared = along[n, s, 0], along[n, s, 1], along[n, s, 2], common[n, s]
            cosines = rows[n * directions + s, :features]
            sines = rows[n * directions + s, features:]
            for f in range(features):
                cycles = view_cycles[f] + shared + x * g[f] + y * h[f] + z * k[f]
                cosines[f], sines[f] = cos_sin(cycles)


@compiled(nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def cycles_rows(inputs: Any, frequencies: Any, cycles: Any) -> None:
    """Sets cycles [N,F] in [0, 1), float32, to inputs [N,K] times frequencies [K,F], both float64, modulo 1."""
    features = frequencies.shape[1]
    sums = np.empty(features)
    for n in range(inputs.shape[0]):
        row = cycles[n]
        sums[:] = 0.0
        for k in range(inputs.shape[1]):
            factor, along = inputs[n, k], frequencies[k]
            for f in range(features):
                sums[f] += factor * along[f]
        for f in range(features):
            row[f] = sums[f] - np.floor(sums[f])
