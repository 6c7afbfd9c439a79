"""Connections: what a walk's event receives from given directions of incidence, without waiting for the walk to leave.

Here for index-matched objects, where every scattering event looks straight towards the light; rough interfaces are in
`prt_bake.trainer.connect_rough`.
"""

from typing import Any

import numpy as np

from prt_bake.trainer.compiled import walk_function
from prt_bake.trainer.counter import uniform
from prt_bake.trainer.embree import nearest_hit
from prt_bake.trainer.media import phase, transmittance
from prt_bake.trainer.walk import AT, CLEARANCE, DIRECTION, FACE, POSITION, THROUGHPUT


@walk_function()
def straight_transmittance(
    boundary: Any, medium: Any, p: Any, d: Any, skip: Any, at: Any, ray: Any, stream: Any
) -> Any:
    """Transmittance from p along d to infinity through an index-matched object, every crossing included."""
    kept = 1.0
    near = 0.0
    begun = 0.0
    while kept > 0.0:
        face, t = nearest_hit(boundary.intersect, boundary.scene, ray, p, d, near, np.inf, skip)
        if face < 0:
            return kept
        g = boundary.face_normals[face]
        leaves = d[0] * g[0] + d[1] * g[1] + d[2] * g[2] > 0.0
        if leaves:
            kept *= transmittance(medium, p, d, begun, t, at, stream)
        begun = t
        near = t + CLEARANCE
        skip = face
    return kept


@walk_function()
def connect_straight(
    boundary: Any, medium: Any, state: Any, counts: Any, incident: Any, share: Any, ray: Any, stream: Any, value: Any
) -> None:
    """Add to value [D,3] what a scattering event receives from the directions incident [D,3], index-matched.

    `share` of the directions are looked at in turn from a random first one, each weighted by D / looked at.
    """
    count = incident.shape[0]
    looked = min(count, share)
    first = 0 if looked == count else int(uniform(stream) * count)
    d = state[DIRECTION : DIRECTION + 3]
    p = state[POSITION : POSITION + 3]
    for j in range(looked):
        i = (first + j * count // looked) % count
        w = incident[i]
        cosine = d[0] * w[0] + d[1] * w[1] + d[2] * w[2]
        kept = straight_transmittance(boundary, medium, p, w, counts[FACE], state[AT : AT + 3], ray, stream)
        weight = phase(cosine, medium.phase_g) * kept * count / looked
        for c in range(3):
            value[i, c] += state[THROUGHPUT + c] * weight
