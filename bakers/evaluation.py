"""Evaluates a transport at a list of bins through the interface that it offers."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bakers.transport import as_radiance, transport_kind

Array = NDArray[np.float64]
Index = NDArray[np.int64]


def values_at(transport: Any, incident: Array, taken: Index, positions: Array, outgoing: Array) -> NDArray[np.floating]:
    """Ŝ [M,D,3] at positions [M,3] seen along outgoing [M,3], for the direction sets incident [R,D,3] of index `taken`
    [M].
    """
    return values_on_sets(transport, incident, taken[:, None], positions, outgoing[:, None])[:, 0]


def values_on_sets(
    transport: Any, incident: Array, rotation: Index, positions: Array, outgoing: Array
) -> NDArray[np.floating]:
    """Ŝ [n,B,D,3] at positions [n,3] seen along outgoing [n,B,3], for the direction sets incident [R,D,3] of index
    `rotation` [n,B].
    """
    expected = (*rotation.shape, incident.shape[1], 3)
    if transport_kind(transport) == "block":
        result = transport.evaluate_block(incident, rotation, positions, outgoing)
        return as_radiance(result, expected, "evaluate_block")
    sets = incident[rotation.reshape(-1)]
    # Copies: a transport of a user may write into what it is given.
    at, eye = np.repeat(positions, rotation.shape[1], axis=0), np.array(outgoing.reshape(-1, 3))
    result = transport.evaluate(sets, at, eye)
    return as_radiance(result, (len(sets), *expected[2:]), "evaluate").reshape(expected)
