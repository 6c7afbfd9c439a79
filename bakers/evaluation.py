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
    directions = incident.shape[1]
    if transport_kind(transport) == "block":
        result = transport.evaluate_block(incident, taken[:, None], positions, outgoing[:, None])
        return as_radiance(result, (len(taken), 1, directions, 3), "evaluate_block")[:, 0]
    # Copies: a transport of a user may write into what it is given.
    result = transport.evaluate(incident[taken], np.array(positions), np.array(outgoing))
    return as_radiance(result, (len(taken), directions, 3), "evaluate")
