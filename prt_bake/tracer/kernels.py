"""Compiled loops of the estimators over slices of queries, for `in_threads`. Results do not depend on the thread count.

Sums [SUMS] of a value are those of `prt_bake.mathematics.moments`: the first value and powers of deviations from it.
Raw powers would lose the variance of walks that all carry nearly the same.
"""

import math
from typing import Any

import numpy as np

from prt_bake.geometry.embree import new_ray
from prt_bake.jit.compilation import compiled
from prt_bake.jit.kernel_functions import called_function, inlined_function
from prt_bake.mathematics.counter import begin_stream
from prt_bake.tracer.connect import connect_straight, unscattered
from prt_bake.tracer.connect_rough import (
    ENTERING,
    connect_arrival,
    connect_next_arrival,
    connect_next_event,
    is_outermost,
)
from prt_bake.tracer.surface.boundary import containing_parts
from prt_bake.tracer.surface.interface import MATCHED, ROUGH
from prt_bake.tracer.volume.media import is_heterogeneous
from prt_bake.tracer.walk import (
    BEFORE,
    BEHIND,
    CLEARANCE,
    COUNTS_SIZE,
    DIRECTION,
    LOST,
    SCATTERED,
    SCATTERING,
    SKY,
    STATE_SIZE,
    SURFACE,
    THROUGHPUT,
    advance,
    begin,
    bounce,
    cross,
    enter,
    region_of,
    scatter,
    survives_roulette,
    view_clearance,
)


@called_function()
def harmonics(x: Any, y: Any, z: Any, degree: Any, basis: Any) -> None:
    """Real orthonormal harmonics of one direction into basis [K], as `prt_bake.mathematics.sh.evaluate`."""
    diagonal = math.sqrt(0.25 / math.pi)
    cosine, sine = 1.0, 0.0
    for m in range(degree + 1):
        if m > 0:
            diagonal *= math.sqrt((2.0 * m + 1.0) / (2.0 * m))
            cosine, sine = x * cosine - y * sine, x * sine + y * cosine
        twice = 1.0 if m == 0 else math.sqrt(2.0)
        before, legendre = 0.0, diagonal
        last = 0.0
        for l in range(m, degree + 1):
            if l > m:
                step = math.sqrt((4.0 * l * l - 1.0) / (l * l - m * m))
                before, legendre = legendre, step * (z * legendre - (before / last if l > m + 1 else 0.0))
                last = step
            basis[l * (l + 1) + m] = twice * legendre * cosine
            if m > 0:
                basis[l * (l + 1) - m] = twice * legendre * sine


@inlined_function()
def _add_powers(value: Any, first: Any, sums: Any) -> None:
    for j in range(value.shape[0]):
        if first:
            sums[0, j] = value[j]
        x = value[j] - sums[0, j]
        if x != 0.0:
            square = x * x
            sums[1, j] += x
            sums[2, j] += square
            sums[3, j] += square * x
            sums[4, j] += square * square


@called_function()
def containing_mask(boundary: Any, position: Any, face: Any, inward: Any, ray: Any) -> Any:
    """Mask of the inner parts that contain a query's point; `inward` is scratch space [3]."""
    if not boundary.nested:
        return 0
    for k in range(3):
        inward[k] = -boundary.faces[face, k]
    return containing_parts(boundary, position, inward, face, ray)


@called_function()
def _connect_and_cross(
    boundary: Any,
    media: Any,
    state: Any,
    counts: Any,
    incident: Any,
    connections: Any,
    next_event: Any,
    ray: Any,
    scratch: Any,
    event: Any,
    stream: Any,
    received: Any,
) -> bool:
    """Connect and sample the event (ENTERING or SURFACE) at a dielectric boundary of an object that is rough outside.

    False if the walk ends there.
    """
    entering = event == ENTERING
    outermost = entering or is_outermost(boundary, counts[BEFORE], counts[BEHIND])
    if outermost:
        if not entering:
            connect_arrival(boundary, state, counts, incident, connections, next_event, ray, scratch, received)
        connect_next_event(
            boundary, media, state, counts, incident, connections, next_event, ray, scratch, event, stream, received
        )
    alive = enter(boundary, state, counts, stream) if entering else cross(boundary, state, counts, False, stream)
    if alive and outermost and region_of(boundary, counts) > 0:
        connect_next_arrival(
            boundary, media, state, counts, incident, connections, next_event, ray, scratch, entering, stream, received
        )
    return alive


@inlined_function()
def _connect_and_sample(
    boundary: Any,
    media: Any,
    state: Any,
    counts: Any,
    event: Any,
    incident: Any,
    connections: Any,
    next_event: Any,
    ray: Any,
    scratch: Any,
    stream: Any,
    received: Any,
) -> bool:
    """Connect an event of the walk to the directions `incident`, then sample it. False if the walk ends there."""
    rough = boundary.kind == ROUGH
    if rough and event == SURFACE:
        return _connect_and_cross(
            boundary, media, state, counts, incident, connections, next_event, ray, scratch, event, stream, received
        )
    if rough:
        connect_next_event(
            boundary, media, state, counts, incident, connections, next_event, ray, scratch, event, stream, received
        )
    else:
        connect_straight(boundary, media, state, counts, event, incident, connections, ray, scratch, stream, received)
    return sample_event(boundary, media, state, counts, event, stream)


@inlined_function()
def sample_event(boundary: Any, media: Any, state: Any, counts: Any, event: Any, stream: Any) -> bool:
    """Sample the walk's direction after its event. False if it ends there."""
    if event == SURFACE:
        return cross(boundary, state, counts, False, stream)
    if event == SCATTERING:
        scatter(boundary, media, state, counts, stream)
    else:
        bounce(boundary, state, counts, stream)
    return True


@compiled(nogil=True)
def sum_transport(
    start: Any,
    stop: Any,
    boundary: Any,
    media: Any,
    queries: Any,
    chunks: Any,
    incident: Any,
    connections: Any,
    next_event: Any,
    seed: Any,
    sums: Any,
) -> None:
    """Power sums [chunks, 5, D·3 + 4] of Ŝ for incident [N,D,3], of the unscattered transmittance, and of what was
    lost.

    chunks int64 [., 3]: (query, first path, paths).
    """
    keys, positions, outgoing, faces, barycentric = queries
    direction_count = incident.shape[1]
    for i in range(start, stop):
        n = chunks[i, 0]
        ray = new_ray()
        state, counts, scratch = np.zeros(STATE_SIZE), np.zeros(COUNTS_SIZE, np.int64), np.zeros(12)
        stream = np.zeros(2, np.uint64)
        value = np.zeros(direction_count * 3 + 4)
        received = value[: direction_count * 3].reshape(direction_count, 3)
        query_incident = incident[n]
        mask = containing_mask(boundary, positions[n], faces[n], scratch[0:3], ray)
        clearance = view_clearance(boundary, positions[n], outgoing[n], faces[n], scratch[0:3], ray)
        crosses = boundary.kind == MATCHED
        for path in range(chunks[i, 1], chunks[i, 1] + chunks[i, 2]):
            begin_stream(stream, seed, keys[n], path)
            value[:-4] = 0.0
            begin(
                boundary, state, counts, positions[n], outgoing[n], faces[n], barycentric[n, 0], barycentric[n, 1], mask
            )
            if boundary.kind == ROUGH:
                # A literal would have its own type, and compile a second version of every function it is passed to.
                first = np.int64(ENTERING)
                alive = _connect_and_cross(
                    boundary,
                    media,
                    state,
                    counts,
                    query_incident,
                    connections,
                    next_event,
                    ray,
                    scratch,
                    first,
                    stream,
                    received,
                )
            else:
                alive = enter(boundary, state, counts, stream)
                state[CLEARANCE] = clearance
                if crosses:
                    # In a homogeneous medium the transmittance is exact: that of the first path is kept for all.
                    crosses = is_heterogeneous(media)
                    unscattered(boundary, media, state, counts, ray, stream, value[-4:-1])
            while alive:
                event = advance(boundary, media, state, counts, ray, stream)
                if event == SKY:
                    break
                alive = _connect_and_sample(
                    boundary,
                    media,
                    state,
                    counts,
                    event,
                    query_incident,
                    connections,
                    next_event,
                    ray,
                    scratch,
                    stream,
                    received,
                ) and survives_roulette(boundary, state, counts, stream)
            value[-1] = state[LOST]
            _add_powers(value, path == chunks[i, 1], sums[i])


@inlined_function()
def walk_out(boundary: Any, media: Any, state: Any, counts: Any, ray: Any, stream: Any) -> bool:
    """Walk until the object is left for good. False if the walk ends before (absorbed or lost)."""
    while True:
        event = advance(boundary, media, state, counts, ray, stream)
        if event == SKY:
            return True
        if not sample_event(boundary, media, state, counts, event, stream):
            return False
        if not survives_roulette(boundary, state, counts, stream):
            return False


@compiled(nogil=True)
def sum_coefficients(
    start: Any, stop: Any, boundary: Any, media: Any, queries: Any, chunks: Any, degree: Any, seed: Any, sums: Any
) -> None:
    """Power sums [chunks, 5, K·3 + 4] of throughput · Y_lm(exit), of the unscattered throughput, and of what was
    lost.
    """
    keys, positions, outgoing, faces, barycentric = queries
    size = (degree + 1) * (degree + 1)
    for i in range(start, stop):
        n = chunks[i, 0]
        ray = new_ray()
        state, counts = np.zeros(STATE_SIZE), np.zeros(COUNTS_SIZE, np.int64)
        stream = np.zeros(2, np.uint64)
        value, basis = np.zeros(size * 3 + 4), np.zeros(size)
        mask = containing_mask(boundary, positions[n], faces[n], state[0:3], ray)
        for path in range(chunks[i, 1], chunks[i, 1] + chunks[i, 2]):
            begin_stream(stream, seed, keys[n], path)
            value[:] = 0.0
            begin(
                boundary, state, counts, positions[n], outgoing[n], faces[n], barycentric[n, 0], barycentric[n, 1], mask
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
            _add_powers(value, path == chunks[i, 1], sums[i])


@compiled(nogil=True)
def draw_exits(
    start: Any,
    stop: Any,
    boundary: Any,
    media: Any,
    queries: Any,
    paths: Any,
    seed: Any,
    directions: Any,
    throughput: Any,
    scattered: Any,
) -> None:
    """One exit per path: directions [N,P,3], throughput [N,P,3] (0: never left), scattering events [N,P]."""
    keys, positions, outgoing, faces, barycentric = queries
    for n in range(start, stop):
        ray = new_ray()
        state, counts = np.zeros(STATE_SIZE), np.zeros(COUNTS_SIZE, np.int64)
        stream = np.zeros(2, np.uint64)
        mask = containing_mask(boundary, positions[n], faces[n], state[0:3], ray)
        for path in range(paths):
            begin_stream(stream, seed, keys[n], path)
            begin(
                boundary, state, counts, positions[n], outgoing[n], faces[n], barycentric[n, 0], barycentric[n, 1], mask
            )
            left = enter(boundary, state, counts, stream) and walk_out(boundary, media, state, counts, ray, stream)
            scattered[n, path] = counts[SCATTERED]
            for c in range(3):
                directions[n, path, c] = state[DIRECTION + c]
                throughput[n, path, c] = state[THROUGHPUT + c] if left else 0.0
