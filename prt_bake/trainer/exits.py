"""Where walks leave: the object seen under a sky is the mean of throughput times what the sky sends back along the
exits.
"""

import numpy as np
from numpy.typing import NDArray

from formats.scene import Scene
from prt_bake.surface import Location
from prt_bake.trainer.prepared import prepare

Array = NDArray[np.float64]


def walk_exits(
    scene: Scene,
    faces: NDArray[np.int64],
    barycentric: Array,
    outgoing: Array,
    keys: NDArray[np.uint64],
    paths: int,
    seed: int,
) -> tuple[Array, Array]:
    """Directions [N,P,3] in which walks from N points leave the object, and their throughput [N,P,3] (0: it never
    left).

    faces [N] and barycentric (u, v) [N,2] say where, outgoing [N,3] whither the light goes, keys [N] number the
    queries. Light that crosses without scattering is among the exits.
    """
    from prt_bake.trainer.kernels import draw_exits

    prepared = prepare(scene)
    location = Location(np.asarray(faces, np.int64), np.ascontiguousarray(barycentric, np.float64), np.empty((0, 3)))
    directions, throughput = np.zeros((len(faces), paths, 3)), np.zeros((len(faces), paths, 3))
    draw_exits(
        prepared.boundary,
        prepared.medium,
        prepared.queries(location, np.asarray(outgoing, np.float64), np.asarray(keys, np.uint64)),
        paths,
        seed,
        directions,
        throughput,
        np.zeros((len(faces), paths), np.int64),
    )
    return directions, throughput
