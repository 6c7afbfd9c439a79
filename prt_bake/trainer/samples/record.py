"""`record_samples`: path traces queries to a file, to be learnt from later or elsewhere."""

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
from prt_bake.tracer.prepared import prepare, smooth_part
from prt_bake.trainer.samples.queries import QuerySource
from prt_bake.trainer.samples.rows import StreamSettings, query_description, render

_KEY_STREAM = 0x4B
_VALUES_AT_ONCE = 1 << 17
_WALKS_AT_ONCE = 8
"""Of a query: where it has more, fewer queries are walked between two looks at the clock."""
_CONNECTIONS = 4

Progress = Callable[[int, int], None]
"""progress(queries done, queries asked for)."""


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
    """Path trace `count` queries of the trainer's kind with `walks` walks and `directions` each; returns how many.

    The n-th query and its walks depend on the seed and n alone: a longer file begins with the shorter one. When `stop`
    answers true what is done so far is kept, marked as incomplete.

    Raises SceneError behind a smooth interface, where Ŝ has no values to keep, QueryError for numbers out of range (two
    walks are needed for an error), StorageError where the file cannot be written, SamplesError where an estimate is not
    finite, naming the query; what came before it is kept.
    """
    smooth = smooth_part(scene)
    if smooth is not None:
        raise SceneError(
            f"{scene.path}: the boundary of '{smooth.name}' is smooth: Ŝ has no values there that a file could hold; "
            "train on the scene itself, which learns from walks' exits, or give it a roughness such as 0.05"
        )
    for name, value, least in (("count", count, 1), ("walks", walks, 2), ("directions", directions, 1)):
        if value < least:
            raise QueryError(f"{name}: {value} where {least} or more is expected")
    prepared = prepare(scene)
    shares = {name: getattr(StreamSettings(), name) for name in ("face_share", "edge_share")}
    source = QuerySource(prepared, directions, seed, **shares)
    connections = min(directions, _CONNECTIONS)
    step = max(1, _VALUES_AT_ONCE * _WALKS_AT_ONCE // (directions * max(walks, _WALKS_AT_ONCE)))
    settings = {"connections": connections, "up": scene.up, **shares}
    with SamplesWriter(output, _head(scene, walks, directions, settings, seed)) as writer:
        for first in range(0, count, step):
            queries = source.draw(first, min(step, count - first))
            mean, error = render(prepared, source, queries, walks, connections, seed)
            broken = np.flatnonzero(~np.isfinite(mean + error).all(axis=(1, 2)))
            if broken.size:
                kept = f"{output} holds the {writer.count:,} before it" if writer.count else "none before it was kept"
                if writer.count:
                    writer.finish(complete=False)
                words = query_description(source, first + int(broken[0]))
                raise SamplesError(f"{scene.path}: the estimate of {words} is not finite; {kept}; try another seed")
            keys = query_keys(seed, queries.keys)
            writer.append(keys, queries.positions, queries.outgoing, queries.incident, mean, error)
            if progress is not None:
                progress(writer.count, count)
            if stop is not None and stop():
                break
        writer.finish(complete=writer.count == count)
    return writer.count


def query_keys(seed: int, numbers: NDArray[Any]) -> NDArray[np.uint64]:
    """Keys uint64 [N] that tell the queries of all seeds apart."""
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
