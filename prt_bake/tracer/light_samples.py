"""Walks for pictures: light samples from given directions of incidence, and exit directions.

`sample_transport` estimates Ŝ, which leaves out light that crosses the object without a scattering event. Behind an
index-matched or smooth boundary that light is a delta function, which connections cannot sample: `sample_exits` marks
the exits that carry it, and pictures add it under the complete lighting. Through a rough boundary it is a function that
connections do sample, and no exit is marked.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from formats.scene import Scene
from prt_bake.geometry.surface import Location
from prt_bake.jit.threads import in_threads
from prt_bake.mathematics.moments import SUMS, from_sums
from prt_bake.tracer.prepared import prepare

Array = NDArray[np.float64]

_NUMBERS_AT_ONCE = 4_000_000


class Exits(NamedTuple):
    """Exit directions [N,P,3] of walks, their throughput [N,P,3] (0: never left), and which exits [N,P] are
    unscattered.
    """

    directions: Array
    throughput: Array
    unscattered: NDArray[np.bool_]


def sample_transport(
    scene: Scene,
    faces: NDArray[np.int64],
    barycentric: Array,
    outgoing: Array,
    keys: NDArray[np.uint64],
    incident: Array,
    paths: int,
    seed: int,
) -> Array:
    """Ŝ [N,D,3] [1/sr] of N points for incident [D,3] or [N,D,3]: mean of `paths` walks.

    faces [N] and barycentric (u, v) [N,2] locate the points, outgoing [N,3] points to the eye, keys [N] select the
    random numbers. Under a directional light of unit irradiance from ωi the radiance is Ŝ(ωi). Requires that
    `smooth_part` is None.
    """
    from prt_bake.tracer.kernels import sum_transport

    prepared = prepare(scene)
    count, directions = len(faces), np.shape(incident)[-2]
    towards = np.broadcast_to(np.asarray(incident, np.float64), (count, directions, 3))
    queries = prepared.queries(_location(faces, barycentric), np.asarray(outgoing, np.float64), keys)
    means = np.zeros((count, directions, 3))
    numbers = directions * 3 + 4  # after the directions: unscattered transmittance [3] and lost throughput
    step = max(1, _NUMBERS_AT_ONCE // (SUMS * numbers))
    for begin in range(0, count, step):
        chosen = slice(begin, min(begin + step, count))
        rows = chosen.stop - begin
        chunks = np.stack([np.arange(rows), np.zeros(rows, np.int64), np.full(rows, paths)], axis=1)
        sums = np.zeros((rows, SUMS, numbers))
        in_threads(
            sum_transport,
            rows,
            prepared.boundary,
            prepared.medium,
            queries.rows(chosen),
            chunks,
            # A writable copy: a read-only array has another type, for which the kernel would be compiled again.
            np.array(towards[chosen], order="C"),
            directions,
            prepared.next_event,
            seed,
            sums,
        )
        mean = from_sums(sums.transpose(1, 0, 2), paths).mean
        means[chosen] = mean[:, : directions * 3].reshape(rows, directions, 3)
    return means


def sample_exits(
    scene: Scene,
    faces: NDArray[np.int64],
    barycentric: Array,
    outgoing: Array,
    keys: NDArray[np.uint64],
    paths: int,
    seed: int,
) -> Exits:
    """Exits of `paths` walks from each of N points; arguments as for `sample_transport`."""
    from prt_bake.tracer.kernels import draw_exits

    prepared = prepare(scene)
    directions, throughput = np.zeros((len(faces), paths, 3)), np.zeros((len(faces), paths, 3))
    scattered = np.zeros((len(faces), paths), np.int64)
    in_threads(
        draw_exits,
        len(faces),
        prepared.boundary,
        prepared.medium,
        prepared.queries(_location(faces, barycentric), np.asarray(outgoing, np.float64), keys),
        paths,
        seed,
        directions,
        throughput,
        scattered,
    )
    return Exits(directions, throughput, scattered == 0)


def _location(faces: NDArray[np.int64], barycentric: Array) -> Location:
    return Location(np.asarray(faces, np.int64), np.ascontiguousarray(barycentric, np.float64), np.empty((0, 3)))
