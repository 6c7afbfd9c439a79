"""`record_samples`: path traces training queries into a file, to learn from later or on another machine."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.errors import QueryError, SamplesError, SceneError
from formats.samples import SamplesHead
from formats.samples.writer import SamplesWriter
from formats.scene import Scene
from prt_bake.mathematics.random import hashed
from prt_bake.tracer.prepared import no_values_reason, prepare
from prt_bake.trainer.samples.queries import QuerySource
from prt_bake.trainer.samples.rows import StreamSettings, query_description, trace_values

_KEY_STREAM = 0x4B
_VALUES_AT_ONCE = 1 << 17
_WALKS_AT_ONCE = 8
"""Walks per query above which fewer queries are traced between two calls of `stop`."""
_CONNECTIONS = 4

Progress = Callable[[int, int], None]
"""progress(queries done, queries requested)."""


def record_samples(
    scene: Scene,
    output: str | Path,
    count: int,
    *,
    walks: int = 8,
    directions: int = 8,
    seed: int = 0,
    progress: Progress | None = None,
    stop: Callable[[], bool] | None = None,
) -> int:
    """Path trace `count` training queries with `walks` walks and `directions` directions each, and return their number.

    Query n and its walks depend on the seed and n alone, so a longer file begins with the content of a shorter one.
    Once `stop` returns true the queries traced so far are kept, and the file is marked as incomplete.

    Raises SceneError behind a smooth interface, where Ŝ has no values; QueryError for numbers out of range (an error
    estimate needs two walks); StorageError if the file cannot be written; SamplesError if an estimate is not finite,
    naming the query (the queries before it are kept).
    """
    if reason := no_values_reason(scene):
        raise SceneError(
            f"{scene.path}: {reason}; Ŝ has no values there that a file could store; train on the scene itself, which "
            "learns from the exits of paths"
        )
    for name, value, least in (("count", count, 1), ("walks", walks, 2), ("directions", directions, 1)):
        if value < least:
            raise QueryError(f"{name}: expected {least} or more, found {value}")
    prepared = prepare(scene)
    shares = {name: getattr(StreamSettings(), name) for name in ("face_share", "edge_share")}
    source = QuerySource(prepared, directions, seed, **shares)
    connections = min(directions, _CONNECTIONS)
    step = max(1, _VALUES_AT_ONCE * _WALKS_AT_ONCE // (directions * max(walks, _WALKS_AT_ONCE)))
    settings = {"connections": connections, "up": scene.up, **shares}
    with SamplesWriter(output, _head(scene, walks, directions, settings, seed)) as writer:
        for first in range(0, count, step):
            queries = source.draw(first, min(step, count - first))
            mean, error = trace_values(prepared, source, queries, walks, connections, seed)
            broken = np.flatnonzero(~np.isfinite(mean + error).all(axis=(1, 2)))
            if broken.size:
                kept = f"{output} has the {writer.count:,} before it" if writer.count else "no query was kept"
                if writer.count:
                    writer.finish(complete=False)
                query = query_description(source, first + int(broken[0]))
                raise SamplesError(f"{scene.path}: the estimate of {query} is not finite; {kept}; try another seed")
            keys = query_keys(seed, queries.keys)
            writer.append(keys, queries.positions, queries.outgoing, queries.incident, mean, error)
            if progress is not None:
                progress(writer.count, count)
            if stop is not None and stop():
                break
        writer.finish(complete=writer.count == count)
    return writer.count


def query_keys(seed: int, numbers: NDArray[Any]) -> NDArray[np.uint64]:
    """Keys uint64 [N] that are distinct for the queries of all seeds."""
    return hashed(_KEY_STREAM, seed, np.asarray(numbers).astype(np.int64))


def _head(scene: Scene, walks: int, directions: int, settings: dict[str, Any], seed: int) -> SamplesHead:
    return SamplesHead(
        scene=Path(scene.path).name,
        scene_hash=scene.content_hash,
        unit=scene.unit,
        seed=seed,
        walks=walks,
        directions=directions,
        settings=settings,
    )
