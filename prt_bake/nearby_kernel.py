"""Values of parents brought into the frame of the vertex that is foretold from them, in one sweep."""

import numpy as np
from numpy.typing import NDArray

from bakers.nearby_vertices import cubic_taps
from prt_bake.compilation import compiled

Array = NDArray[np.float64]


def all_turned(known: NDArray[np.float32], places: NDArray[np.int64], turns: Array) -> Array:
    """Values [P,R·S,C] of known[places], known being [G,R,S,C], as `bakers.nearby_vertices.turned` by turns [P]."""
    rings, sectors, channels = known.shape[1:]
    steps = [cubic_taps(float(turn), sectors) for turn in turns]
    whole = np.array([step[0] % sectors for step in steps])
    out = np.empty((len(places), rings, sectors * channels))
    _sweep(known.reshape(len(known), rings, -1), places, whole, np.array([step[1] for step in steps]), channels, out)
    return out.reshape(len(places), rings * sectors, channels)


@compiled(nogil=True)
def _sweep(
    known: NDArray[np.float32],
    places: NDArray[np.int64],
    whole: NDArray[np.int64],
    taps: Array,
    channels: int,
    out: Array,
) -> None:
    """Fills in out [P,R,S·C]. A ring is laid out with its ends repeated, so that every sum runs straight through."""
    length = known.shape[2]
    ring = np.empty(length + 3 * channels)
    for p in range(len(places)):
        start = (whole[p] - 1) * channels % length
        a, b, c, d = taps[p]
        for r in range(known.shape[1]):
            values = known[places[p], r]
            done = 0
            while done < len(ring):
                many = min(length - start, len(ring) - done)
                ring[done : done + many] = values[start : start + many]
                done += many
                start = (start + many) % length
            start = (whole[p] - 1) * channels % length
            one, two, three = ring[channels:], ring[2 * channels :], ring[3 * channels :]
            for i in range(length):
                out[p, r, i] = a * ring[i] + b * one[i] + c * two[i] + d * three[i]
