"""Kernels for CUDA: walks, one per thread at a time, and sums over their exits."""

from typing import Any

import numpy as np

from prt_bake.mathematics import counter
from prt_bake.tracer import kernels as processor
from prt_bake.tracer import walk
from prt_bake.tracer.gpu.device_functions import cuda, device_function, kernel
from prt_bake.tracer.gpu.traversal import RAY_SIZE
from prt_bake.tracer.walk import COUNTS_SIZE, DIRECTION, LOST, SCATTERED, SKY, STATE_SIZE, THROUGHPUT

_begin_stream = device_function(counter.begin_stream)
_containing_mask, _sample_event, _harmonics = (
    device_function(function) for function in (processor.containing_mask, processor.sample_event, processor.harmonics)
)
_begin, _enter, _advance, _survives_roulette = (
    device_function(function) for function in (walk.begin, walk.enter, walk.advance, walk.survives_roulette)
)
MOST_HARMONICS = 64
"""Most numbers of a basis: harmonics up to degree 7."""


@kernel
def draw_exits(
    boundary: Any, media: Any, queries: Any, first_path: Any, paths: Any, seed: Any, next_walk: Any, exits: Any
) -> None:
    """Exits of walks, as `prt_bake.tracer.kernels.draw_exits`, of paths first_path[n] … first_path[n] + paths − 1.

    exits are directions and throughput [N,P,3] (0: never left), scattering events and lost throughput [N,P]. A thread
    whose walk has ended takes the next one from the counter next_walk [1]. Otherwise all threads of a warp would wait
    for the longest of their walks.
    """
    keys, positions, outgoing, faces, barycentric = queries
    directions, throughput, scattered, lost = exits
    ray = cuda.local.array(RAY_SIZE, np.float32)
    state, counts = cuda.local.array(STATE_SIZE, np.float64), cuda.local.array(COUNTS_SIZE, np.int64)
    stream = cuda.local.array(2, np.uint64)
    total = keys.shape[0] * paths
    n, path, alive = 0, 0, False
    while True:
        if not alive:
            number = cuda.atomic.add(next_walk, 0, 1)
            if number >= total:
                return
            n, path = number // paths, number % paths
            mask = _containing_mask(boundary, positions[n], faces[n], state[0:3], ray)
            _begin_stream(stream, seed, keys[n], first_path[n] + path)
            _begin(
                boundary, state, counts, positions[n], outgoing[n], faces[n], barycentric[n, 0], barycentric[n, 1], mask
            )
            alive = _enter(boundary, state, counts, stream)
        left = False
        if alive:
            event = _advance(boundary, media, state, counts, ray, stream)
            left = event == SKY
            alive = (
                not left
                and _sample_event(boundary, media, state, counts, event, stream)
                and _survives_roulette(boundary, state, counts, stream)
            )
        if not alive:
            scattered[n, path], lost[n, path] = counts[SCATTERED], state[LOST]
            for c in range(3):
                directions[n, path, c] = state[DIRECTION + c]
                throughput[n, path, c] = state[THROUGHPUT + c] if left else 0.0


@kernel
def sum_powers(exits: Any, degree: Any, sums: Any) -> None:
    """Sums [N,5,K·3 + 4] over the exits of N queries, as `prt_bake.tracer.kernels.sum_coefficients`.

    Each thread sums one number of one query.
    """
    directions, throughput, scattered, lost = exits
    thread = cuda.grid(1)
    numbers = sums.shape[2]
    if thread >= sums.shape[0] * numbers:
        return
    n, j = thread // numbers, thread % numbers
    basis = cuda.local.array(MOST_HARMONICS, np.float64)
    first, one, two, three, four = 0.0, 0.0, 0.0, 0.0, 0.0
    for path in range(directions.shape[1]):
        value = 0.0
        if j == numbers - 1:
            value = np.float64(lost[n, path])
        elif j >= numbers - 4:
            value = np.float64(throughput[n, path, j - numbers + 4]) if scattered[n, path] == 0 else 0.0
        elif scattered[n, path] > 0:
            d = directions[n, path]
            _harmonics(np.float64(d[0]), np.float64(d[1]), np.float64(d[2]), degree, basis)
            value = throughput[n, path, j % 3] * basis[j // 3]
        if path == 0:
            first = value
        x = value - first
        one += x
        two += x * x
        three += x * x * x
        four += x * x * x * x
    sums[n, 0, j], sums[n, 1, j], sums[n, 2, j], sums[n, 3, j], sums[n, 4, j] = first, one, two, three, four
