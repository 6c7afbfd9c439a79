"""The estimators' loops over slices of chunks or of queries, for `in_threads`: four power sums of every value, the same
numbers for any thread count.
"""

from typing import Any

import numpy as np

from prt_bake.jit.compilation import compiled
from prt_bake.jit.without_counts import called_function, walk_function
from prt_bake.mathematics.counter import begin_stream
from prt_bake.tracer.connect import connect_straight, unscattered
from prt_bake.tracer.connect_rough import ENTERING, connect_ahead, connect_aimed, connect_at_surface, is_outermost
from prt_bake.tracer.surface.boundary import contained
from prt_bake.tracer.surface.embree import new_ray
from prt_bake.tracer.surface.interface import MATCHED, ROUGH
from prt_bake.tracer.volume.media import is_uneven
from prt_bake.tracer.walk import (
    BEFORE,
    BEHIND,
    COUNTS_SIZE,
    DIRECTION,
    LOST,
    ROOM,
    SCATTERED,
    SCATTERING,
    SKY,
    STATE_SIZE,
    SURFACE,
    THROUGHPUT,
    advance,
    begin,
    bounce,
    clear_view,
    cross,
    enter,
    goes_on,
    region_of,
    scatter,
)


@called_function()
def harmonics(x: Any, y: Any, z: Any, degree: Any, basis: Any) -> None:
    """Real orthonormal harmonics of one direction into basis [K], as prt_bake.mathematics.sh.evaluate (its tests
    compare them).
    """
    diagonal = np.sqrt(0.25 / np.pi)
    cosine, sine = 1.0, 0.0
    for m in range(degree + 1):
        if m > 0:
            diagonal *= np.sqrt((2.0 * m + 1.0) / (2.0 * m))
            cosine, sine = x * cosine - y * sine, x * sine + y * cosine
        twice = 1.0 if m == 0 else np.sqrt(2.0)
        before, legendre = 0.0, diagonal
        last = 0.0
        for l in range(m, degree + 1):
            if l > m:
                step = np.sqrt((4.0 * l * l - 1.0) / (l * l - m * m))
                before, legendre = legendre, step * (z * legendre - (before / last if l > m + 1 else 0.0))
                last = step
            basis[l * (l + 1) + m] = twice * legendre * cosine
            if m > 0:
                basis[l * (l + 1) - m] = twice * legendre * sine


@walk_function()
def _add_powers(value: Any, sums: Any) -> None:
    for j in range(value.shape[0]):
        x = value[j]
        if x != 0.0:
            square = x * x
            sums[0, j] += x
            sums[1, j] += square
            sums[2, j] += square * x
            sums[3, j] += square * square


@called_function()
def _held_at(boundary: Any, position: Any, face: Any, inward: Any, ray: Any) -> Any:
    """Mask of the parts inside the object that hold a query's point too; `inward` is room for a direction."""
    if not boundary.nested:
        return 0
    for k in range(3):
        inward[k] = -boundary.faces[face, k]
    return contained(boundary, position, inward, face, ray)


@called_function()
def _receive_rough(
    boundary: Any,
    media: Any,
    state: Any,
    counts: Any,
    towards: Any,
    share: Any,
    aims: Any,
    ray: Any,
    room: Any,
    event: Any,
    stream: Any,
    received: Any,
) -> bool:
    """Take the event (ENTERING or SURFACE) at a dielectric boundary in an object that is rough outside, with all that
    it receives; False where the walk ends.
    """
    entering = event == ENTERING
    outermost = entering or is_outermost(boundary, counts[BEFORE], counts[BEHIND])
    if outermost:
        if not entering:
            connect_at_surface(boundary, state, counts, towards, share, aims, ray, room, received)
        connect_aimed(boundary, media, state, counts, towards, share, aims, ray, room, event, stream, received)
    alive = enter(boundary, state, counts, stream) if entering else cross(boundary, state, counts, False, stream)
    if alive and outermost and region_of(boundary, counts) > 0:
        connect_ahead(boundary, media, state, counts, towards, share, aims, ray, room, entering, stream, received)
    return alive


@walk_function()
def _receive(
    boundary: Any,
    media: Any,
    state: Any,
    counts: Any,
    event: Any,
    towards: Any,
    share: Any,
    aims: Any,
    ray: Any,
    room: Any,
    stream: Any,
    received: Any,
) -> bool:
    """Take an event of the walk with all that it receives from `towards`; False where the walk ends there."""
    rough = boundary.kind == ROUGH
    if rough and event == SURFACE:
        return _receive_rough(boundary, media, state, counts, towards, share, aims, ray, room, event, stream, received)
    if rough:
        connect_aimed(boundary, media, state, counts, towards, share, aims, ray, room, event, stream, received)
    else:
        connect_straight(boundary, media, state, counts, event, towards, share, ray, room, stream, received)
    return _take(boundary, media, state, counts, event, stream)


@walk_function()
def _take(boundary: Any, media: Any, state: Any, counts: Any, event: Any, stream: Any) -> bool:
    """Send the walk on from its event; False where it ends there."""
    if event == SURFACE:
        return cross(boundary, state, counts, False, stream)
    if event == SCATTERING:
        scatter(boundary, media, state, counts, stream)
    else:
        bounce(boundary, state, counts, stream)
    return True


@compiled(nogil=True)
def sum_transport(
    begun: Any,
    ended: Any,
    boundary: Any,
    media: Any,
    queries: Any,
    chunks: Any,
    incident: Any,
    share: Any,
    aims: Any,
    seed: Any,
    sums: Any,
) -> None:
    """Power sums [chunks, 4, D·3 + 4] of Ŝ towards incident [N,D,3], then of the unscattered share and of what was
    lost.

    `queries` is (keys uint64, positions, outgoing, faces, barycentric) of the N queries; chunks int64 [., 3] are
    (query, first path, paths).
    """
    keys, positions, outgoing, faces, barycentric = queries
    directions = incident.shape[1]
    for i in range(begun, ended):
        n = chunks[i, 0]
        ray = new_ray()
        state, counts, room = np.zeros(STATE_SIZE), np.zeros(COUNTS_SIZE, np.int64), np.zeros(12)
        stream = np.zeros(2, np.uint64)
        value = np.zeros(directions * 3 + 4)
        received = value[: directions * 3].reshape(directions, 3)
        towards = incident[n]
        held = _held_at(boundary, positions[n], faces[n], room[0:3], ray)
        ahead = clear_view(boundary, positions[n], outgoing[n], faces[n], room[0:3], ray)
        through = boundary.kind == MATCHED
        for path in range(chunks[i, 1], chunks[i, 1] + chunks[i, 2]):
            begin_stream(stream, seed, keys[n], path)
            value[:] = 0.0
            begin(
                boundary, state, counts, positions[n], outgoing[n], faces[n], barycentric[n, 0], barycentric[n, 1], held
            )
            if boundary.kind == ROUGH:
                # As a number like any other: of a constant there would be a second form of all that is called with it.
                first = np.int64(ENTERING)
                alive = _receive_rough(
                    boundary, media, state, counts, towards, share, aims, ray, room, first, stream, received
                )
            else:
                alive = enter(boundary, state, counts, stream)
                state[ROOM] = ahead
                if through:
                    # Where it is the same for all paths, the first one tells for all.
                    through = is_uneven(media)
                    unscattered(boundary, media, state, counts, ray, stream, value[-4:-1])
                    if not through:
                        for c in range(3):
                            value[c - 4] *= chunks[i, 2]
            while alive:
                event = advance(boundary, media, state, counts, ray, stream)
                if event == SKY:
                    break
                alive = _receive(
                    boundary, media, state, counts, event, towards, share, aims, ray, room, stream, received
                ) and goes_on(boundary, state, counts, stream)
            value[-1] = state[LOST]
            _add_powers(value, sums[i])


@walk_function()
def walk_out(boundary: Any, media: Any, state: Any, counts: Any, ray: Any, stream: Any) -> bool:
    """Walk until the object is left for good; False where the walk ends before (absorbed, or lost)."""
    while True:
        event = advance(boundary, media, state, counts, ray, stream)
        if event == SKY:
            return True
        if not _take(boundary, media, state, counts, event, stream):
            return False
        if not goes_on(boundary, state, counts, stream):
            return False


@compiled(nogil=True)
def sum_coefficients(
    begun: Any, ended: Any, boundary: Any, media: Any, queries: Any, chunks: Any, degree: Any, seed: Any, sums: Any
) -> None:
    """Power sums [chunks, 4, K·3 + 4] of throughput · Y_lm(exit), of the unscattered share and of what was lost."""
    keys, positions, outgoing, faces, barycentric = queries
    size = (degree + 1) * (degree + 1)
    for i in range(begun, ended):
        n = chunks[i, 0]
        ray = new_ray()
        state, counts = np.zeros(STATE_SIZE), np.zeros(COUNTS_SIZE, np.int64)
        stream = np.zeros(2, np.uint64)
        value, basis = np.zeros(size * 3 + 4), np.zeros(size)
        held = _held_at(boundary, positions[n], faces[n], state[0:3], ray)
        for path in range(chunks[i, 1], chunks[i, 1] + chunks[i, 2]):
            begin_stream(stream, seed, keys[n], path)
            value[:] = 0.0
            begin(
                boundary, state, counts, positions[n], outgoing[n], faces[n], barycentric[n, 0], barycentric[n, 1], held
            )
            if enter(boundary, state, counts, stream) and walk_out(boundary, media, state, counts, ray, stream):
                if counts[SCATTERED] == 0:
                    for c in range(3):
                        value[c - 4] = state[THROUGHPUT + c]
                else:
                    harmonics(state[DIRECTION], state[DIRECTION + 1], state[DIRECTION + 2], degree, basis)
                    for k in range(size):
                        for c in range(3):
                            value[3 * k + c] = state[THROUGHPUT + c] * basis[k]
            value[-1] = state[LOST]
            _add_powers(value, sums[i])


@compiled(nogil=True)
def draw_exits(
    begun: Any,
    ended: Any,
    boundary: Any,
    media: Any,
    queries: Any,
    paths: Any,
    seed: Any,
    directions: Any,
    throughput: Any,
    scattered: Any,
) -> None:
    """One exit a path: directions [N,P,3], throughput [N,P,3] (0: never left), scattered [N,P] (0: it met nothing)."""
    keys, positions, outgoing, faces, barycentric = queries
    for n in range(begun, ended):
        ray = new_ray()
        state, counts = np.zeros(STATE_SIZE), np.zeros(COUNTS_SIZE, np.int64)
        stream = np.zeros(2, np.uint64)
        held = _held_at(boundary, positions[n], faces[n], state[0:3], ray)
        for path in range(paths):
            begin_stream(stream, seed, keys[n], path)
            begin(
                boundary, state, counts, positions[n], outgoing[n], faces[n], barycentric[n, 0], barycentric[n, 1], held
            )
            left = enter(boundary, state, counts, stream) and walk_out(boundary, media, state, counts, ray, stream)
            scattered[n, path] = counts[SCATTERED]
            for c in range(3):
                directions[n, path, c] = state[DIRECTION + c]
                throughput[n, path, c] = state[THROUGHPUT + c] if left else 0.0
