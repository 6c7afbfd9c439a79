"""Fourier features of views and directions from those of each, compiled: exp(i·phase) is a product of both, taken in
one sweep that ends in the type of the matrix work.
"""

from typing import Any

import numpy as np

from prt_bake.jit.compilation import compiled

_HALF, _LOW, _BITS = np.uint32(0x7FFF), np.uint32(1), np.uint32(16)


@compiled(nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def product_rows(light: Any, chosen: Any, view: Any, rows: Any) -> None:
    """Fill rows [N·D, 2F] with [cosines, sines] of view n and direction d of the set light[chosen[n]], in row n·D + d.

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
                    # To the nearest, ties to even.
                    out[f] = (bits[f] + _HALF + ((bits[f] >> _BITS) & _LOW)) >> _BITS
