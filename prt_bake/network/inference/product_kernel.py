"""Compiled Fourier features of a view and a direction as the complex product of their exponentials exp(i·phase)."""

from typing import Any

import numpy as np

from prt_bake.jit.compilation import compiled

_HALF, _LOW, _BITS = np.uint32(0x7FFF), np.uint32(1), np.uint32(16)


@compiled(nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def product_rows(light: Any, chosen: Any, view: Any, rows: Any) -> None:
    """Fills row n·D + d of rows [N·D, 2F] with [cosines, sines] of view n and direction d of light[chosen[n]].

    light [R,D,2F] and view [N,2F] float32 hold cosines, then sines; rows are float32, or bfloat16's bits as uint16.
    """
    directions, width = light.shape[1:]
    features = width // 2
    row = np.empty(width, np.float32)
    bits = row.view(np.uint32)
    for n in range(len(chosen)):
        c, s = view[n, :features], view[n, features:]
        for d in range(directions):
            a, b = light[chosen[n], d, :features], light[chosen[n], d, features:]
            out = rows[n * directions + d]
            if rows.itemsize == 4:
                for f in range(features):
                    out[f] = a[f] * c[f] - b[f] * s[f]
                    out[features + f] = a[f] * s[f] + b[f] * c[f]
            else:
                for f in range(features):
                    row[f] = a[f] * c[f] - b[f] * s[f]
                    row[features + f] = a[f] * s[f] + b[f] * c[f]
                for f in range(width):
                    # Round to nearest, ties to even.
                    out[f] = (bits[f] + _HALF + ((bits[f] >> _BITS) & _LOW)) >> _BITS
