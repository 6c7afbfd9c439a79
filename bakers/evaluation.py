"""Asking a transport for Ŝ at a list of bins, by whichever way in it offers."""

import numpy as np
from numpy.typing import NDArray

from bakers.transport import as_radiance, way_in

Array = NDArray[np.float64]
Index = NDArray[np.int64]


def values_at(
    transport: object, incident: Array, taken: Index, positions: Array, outgoing: Array
) -> NDArray[np.floating]:
    """Ŝ [M,D,3] at positions [M,3] along outgoing [M,3], lit from the sets incident [R,D,3] that `taken` [M] names."""
    offered: object = transport
    directions = incident.shape[1]
    if way_in(transport) == "block":
        answer = offered.evaluate_block(incident, taken[:, None], positions, outgoing[:, None])  # type: ignore[attr-defined]
        return as_radiance(answer, (len(taken), 1, directions, 3), "evaluate_block")[:, 0]
    answer = offered.evaluate(incident[taken], positions, outgoing)  # type: ignore[attr-defined]
    return as_radiance(answer, (len(taken), directions, 3), "evaluate")
