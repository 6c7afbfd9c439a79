"""Training rows: path-traced queries as rows of numbers.

A row is a query: its position relative to the box, its direction to the eye, and its rays, each a direction and three
channels. Rays are of one of two kinds. Values: the directions are directions of incidence, the channels are Ŝ there.
Exits: the directions are those in which walks left the object, the channels are the walks' throughput (0 for a walk
that was absorbed or that crossed unscattered, since that light is not part of Ŝ).

Behind a smooth interface there are only exits. Behind a rough interface both exist and exits are better: a connection
through the interface costs as much as ten walks, and at equal time the coefficients from exits have less than half the
variance (`tests/bench/noise_of_a_walk.py`). If the boundary does not bend light, connections are ten times better, but
exits still leave less error in equal time: low bands learn from exits alone (`docs/measurements/low_bands.md`).
"""

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from formats.errors import QueryError
from formats.scene import Scene
from prt_bake.geometry.surface import Location
from prt_bake.jit.threads import in_threads
from prt_bake.mathematics.moments import SUMS, from_sums
from prt_bake.tracer.light_samples import Exits
from prt_bake.tracer.prepared import PreparedScene, no_values_reason, prepare
from prt_bake.trainer.samples.queries import EDGE_SHARE, Queries, QuerySource

if TYPE_CHECKING:
    from prt_bake.trainer.samples.traced import TracedQueries

Array = NDArray[np.float64]

POSITION, OUTGOING = slice(0, 3), slice(3, 6)
BEFORE_RAYS, RAY_SIZE = 6, 6
INCIDENT, CHANNELS = slice(0, 3), slice(3, 6)
"""Columns of a ray."""


class Batch(NamedTuple):
    """Rows [Q, 6 + 6 R] float32 of Q queries with R rays each, and the queries' numbers [Q] int64."""

    rows: NDArray[np.float32]
    numbers: NDArray[np.int64]

    @property
    def rays(self) -> NDArray[np.float32]:
        """Directions and channels [Q,R,6]."""
        return np.asarray(rays_of(self.rows))


def rays_of(rows: Any) -> Any:
    """The rays [Q,R,6] of rows, an array or a tensor, as a view."""
    return rows[:, BEFORE_RAYS:].reshape(len(rows), -1, RAY_SIZE)


@dataclass(frozen=True)
class StreamSettings:
    """Settings of the renderer of training rows; the defaults have the least measured error after equal time
    (`make bench`).
    """

    queries_a_batch: int = 4096
    rays: Literal["exits", "values"] = "exits"
    """Kind of the rays."""
    directions: int = 8
    """Directions of incidence per query, for values."""
    connections: int = 8
    """Directions that each event of a walk connects to, for values."""
    walks: int = 2
    """Walks per query, for values."""
    exits: int = 32
    """Most walks per query, for exits."""
    least_exits: int = 6
    """Fewest walks per query, for exits, unless `exits` is less. A renderer beside the learner traces as many walks in
    between as it has time for; one that takes turns with the learner traces `exits`."""
    kept: int = 12
    """Rays per query after resampling, for exits (`resampling.py`)."""
    face_share: float = 0.5
    """Share of the queries that are uniform over the faces; the others are uniform over the area."""
    edge_share: float = EDGE_SHARE
    """Share of the queries on vertices and edges, as in a bake."""
    capacity: int = 1 << 17
    """Rows of the buffer."""
    reuse: int = 1
    """How often each row is used at most: a learner that shares the renderer's cores waits for new rows, a learner on
    a GPU does not. If renderer and learner take turns, each row is used exactly that often."""

    def __post_init__(self) -> None:
        for name in (field.name for field in fields(self) if field.type is int):
            if getattr(self, name) < 1:
                raise QueryError(f"stream settings: {name} must be at least 1, found {getattr(self, name)}")
        for name in ("face_share", "edge_share"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise QueryError(f"stream settings: {name} must be 0 to 1, found {getattr(self, name)}")
        if self.rays not in ("exits", "values"):
            raise QueryError(f"stream settings: rays must be exits or values, found {self.rays!r}")


class Box(NamedTuple):
    """The corner [3] and the longest side of the box that positions are relative to."""

    corner: Array
    side: float


class RowSource(Protocol):
    """A source of training rows: a renderer beside the learner, one that takes turns with it, or a file."""

    exits: bool
    """Whether rays are exits of walks instead of values."""
    traced: "TracedQueries | None"
    """All queries so far, of sources of exits."""

    def draw(self, count: int) -> Batch:
        """The next `count` rows; raises the error of a source that failed."""

    def describe(self, number: int) -> str:
        """A query by its number, for messages."""

    def statistics(self) -> "SourceStatistics":
        """Walks and rows so far."""

    def state(self) -> dict[str, int]:
        """State to continue from."""

    def start(self) -> None:
        """Start the source and return once rows can be drawn."""

    def stop(self) -> None:
        """End the source's threads."""


class SourceStatistics(NamedTuple):
    """Walks and rows since the training began, and seconds of path tracing since the source was made."""

    walks: int
    rows: int
    walking: float


class RowTracer(Protocol):
    """Path traces numbered queries as rows."""

    exits: bool
    walks_per_query: int
    """May be changed, down to `fewest_walks`."""
    fewest_walks: int
    traced: "TracedQueries | None"
    """All queries that were rendered, of tracers of exits."""

    def render(self, first: int, count: int) -> Batch:
        """The rows of queries first … first + count − 1."""

    def describe(self, number: int) -> str:
        """A query's number, seed and face, for messages."""


class ValueTracer:
    """Traces rows of values: Ŝ in D directions of incidence that share the query's walks."""

    exits = False
    traced: "TracedQueries | None" = None

    def __init__(self, prepared: PreparedScene, box: Box, settings: StreamSettings, seed: int) -> None:
        """Queries and walks depend on the seed and the query's number alone."""
        self.walks_per_query = self.fewest_walks = settings.walks
        self._prepared, self._box, self._settings, self._seed = prepared, box, settings, seed
        self._source = QuerySource(prepared, settings.directions, seed, settings.face_share, settings.edge_share)

    def render(self, first: int, count: int) -> Batch:
        """The rows of queries first … first + count − 1, with D rays."""
        queries = self._source.draw(first, count)
        mean, _ = trace_values(
            self._prepared, self._source, queries, self._settings.walks, self._settings.connections, self._seed
        )
        return build_batch(queries.keys, queries.positions, queries.outgoing, queries.incident, mean, self._box)

    def describe(self, number: int) -> str:
        """A query's number, seed and face, for messages."""
        return query_description(self._source, number)


class ExitTracer:
    """Traces rows of exits: those of the query's walks, resampled to `kept` rays."""

    exits = True

    def __init__(self, prepared: PreparedScene, box: Box, settings: StreamSettings, seed: int) -> None:
        """Queries and walks depend on the seed and the query's number alone."""
        from prt_bake.trainer.samples.traced import TracedQueries

        self.traced: TracedQueries | None = TracedQueries()
        self.walks_per_query, self._kept = settings.exits, settings.kept
        self.fewest_walks = min(settings.least_exits, settings.exits)
        self._prepared, self._box, self._seed = prepared, box, seed
        self._source = QuerySource(prepared, 1, seed, settings.face_share, settings.edge_share)

    def render(self, first: int, count: int) -> Batch:
        """The rows of queries first … first + count − 1, with `kept` rays."""
        from prt_bake.trainer.samples.resampling import resampled
        from prt_bake.trainer.samples.traced import mean_coefficients

        queries = self._source.draw(first, count)
        exits = trace_exits(self._prepared, self._source, queries, self.walks_per_query, self._seed)
        directions, throughput = exits.directions, np.where(exits.unscattered[..., None], 0.0, exits.throughput)
        coefficients = mean_coefficients(directions, throughput)
        if self._kept != self.walks_per_query:
            directions, throughput = resampled(directions, throughput, self._kept, self._seed, queries.keys)
        batch = build_batch(queries.keys, queries.positions, queries.outgoing, directions, throughput, self._box)
        assert self.traced is not None
        self.traced.add(first, batch.rows[:, :BEFORE_RAYS], coefficients)
        return batch

    def describe(self, number: int) -> str:
        """A query's number, seed and face, for messages."""
        return query_description(self._source, number)


def row_tracer(scene: Scene, box: Box, settings: StreamSettings, seed: int) -> ValueTracer | ExitTracer:
    """The tracer of the rays that `settings` choose; raises QueryError for values behind a smooth interface."""
    if settings.rays == "exits":
        return ExitTracer(prepare(scene), box, settings, seed)
    if reason := no_values_reason(scene):
        raise QueryError(f"{scene.path}: {reason}; Ŝ has no values in given directions there; use rays='exits'")
    return ValueTracer(prepare(scene), box, settings, seed)


def build_batch(
    numbers: NDArray[Any],
    positions: Array,
    outgoing: NDArray[Any],
    directions: NDArray[Any],
    channels: NDArray[Any],
    box: Box,
) -> Batch:
    """Rows of N queries: numbers [N], positions and outgoing [N,3], rays of directions and channels [N,R,3]."""
    count, rays = directions.shape[:2]
    rows = np.empty((count, BEFORE_RAYS + RAY_SIZE * rays), np.float32)
    rows[:, POSITION] = (positions - box.corner) / box.side
    rows[:, OUTGOING] = outgoing
    each = rays_of(rows)
    each[..., INCIDENT], each[..., CHANNELS] = directions, channels
    return Batch(rows, np.asarray(numbers).astype(np.int64))


def query_description(source: QuerySource, number: int) -> str:
    """A query's number, seed and face, for messages."""
    location: Location = source.draw(number, 1).location
    return f"query {number} of seed {source.seed}, on face {int(location.faces[0])}"


def trace_values(
    prepared: PreparedScene, source: QuerySource, queries: Queries, walks: int, connections: int, seed: int
) -> tuple[Array, Array]:
    """Ŝ [N,D,3] of queries and its standard error, NaN for a single walk."""
    from prt_bake.tracer.kernels import sum_transport

    count, directions = queries.incident.shape[:2]
    chunks = np.stack([np.arange(count), np.zeros(count, int), np.full(count, walks)], axis=1)
    sums = np.zeros((count, SUMS, directions * 3 + 4))
    kernel_queries: tuple[Any, ...] = source.for_kernel(queries)
    in_threads(
        sum_transport,
        count,
        prepared.boundary,
        prepared.medium,
        kernel_queries,
        chunks,
        queries.incident,
        connections,
        prepared.next_event,
        seed,
        sums,
    )
    mean, variance, _, _ = from_sums(sums[..., :-4].transpose(1, 0, 2), walks)
    error = np.sqrt(variance / (walks - 1)) if walks > 1 else np.full_like(mean, np.nan)
    return mean.reshape(count, directions, 3), error.reshape(count, directions, 3)


def trace_exits(prepared: PreparedScene, source: QuerySource, queries: Queries, walks: int, seed: int) -> Exits:
    """The exits of `walks` walks from each query."""
    from prt_bake.tracer.kernels import draw_exits

    count = len(queries.keys)
    directions, throughput = np.zeros((count, walks, 3)), np.zeros((count, walks, 3))
    scattered = np.zeros((count, walks), np.int64)
    in_threads(
        draw_exits,
        count,
        prepared.boundary,
        prepared.medium,
        source.for_kernel(queries),
        walks,
        seed,
        directions,
        throughput,
        scattered,
    )
    return Exits(directions, throughput, scattered == 0)
