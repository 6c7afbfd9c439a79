"""What the learner learns from: rows of numbers that walks have filled in.

A row is a query: its position relative to the box, its direction to the eye, and then its rays, each a direction and
three channels. Either the directions are of incidence and the channels are Ŝ towards them. Or the rays are walks: the
directions are those in which they left, and the channels are the throughput that they carried out (0 for a walk that
was absorbed or that met nothing, since that light is not in Ŝ).

Behind a smooth interface there are only exits. Behind a rough one there are both, and exits say more: a connection
through the interface costs as much as ten walks, and at equal time the coefficients that follow from exits have less
than half of the variance (`tests/bench/noise_of_a_walk.py`). Where nothing is bent, connections say ten times as much.
"""

from dataclasses import dataclass, fields
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from formats.errors import QueryError
from formats.scene import Scene
from prt_bake.geometry.surface import Location
from prt_bake.jit.threads import in_threads
from prt_bake.tracer.light_samples import Exits
from prt_bake.tracer.prepared import PreparedScene, is_unbent, smooth_part
from prt_bake.trainer.samples.queries import EDGE_SHARE, Queries, QuerySource

Array = NDArray[np.float64]

POSITION, OUTGOING = slice(0, 3), slice(3, 6)
BEFORE_RAYS, RAY_SIZE = 6, 6
INCIDENT, CHANNELS = slice(0, 3), slice(3, 6)
"""Of a ray."""


class Batch(NamedTuple):
    """Rows [Q, 6 + 6 R] float32 of Q queries with R rays each, and the numbers [Q] int64 of the queries."""

    rows: NDArray[np.float32]
    numbers: NDArray[np.int64]

    @property
    def rays(self) -> NDArray[np.float32]:
        """[Q,R,6]: directions and channels."""
        return np.asarray(rays_of(self.rows))


def rays_of(rows: Any) -> Any:
    """The rays [Q,R,6] of rows, an array or a tensor: a view of them."""
    return rows[:, BEFORE_RAYS:].reshape(len(rows), -1, RAY_SIZE)


@dataclass(frozen=True)
class StreamSettings:
    """How the renderer asks; chosen by measured error after equal time (`make bench`)."""

    queries_a_batch: int = 4096
    rays: Literal["auto", "values", "exits"] = "auto"
    """What rays are. auto: values where the object's boundary bends no light, else exits."""
    directions: int = 8
    """Directions of incidence a query, where rays are values."""
    connections: int = 8
    """How many of them each event of a walk looks at."""
    walks: int = 2
    """Walks that each value is the mean of."""
    exits: int = 32
    """Walks a query at most, where rays are exits."""
    least_exits: int = 6
    """Walks a query at least, where `exits` is not less: between the two a renderer beside the learner walks as often
    as it has time for. Where both take turns it is `exits`."""
    kept: int = 12
    """Rays that their exits are told by (`prt_bake.trainer.samples.resampling`)."""
    face_share: float = 0.5
    """Share of the queries that has every face alike, large or small; of the others an area has as many as another."""
    edge_share: float = EDGE_SHARE
    """Share of the queries that lies on vertices and edges, where a bake asks."""
    capacity: int = 1 << 17
    """Rows that the buffer holds."""
    reuse: int = 1
    """How often each row is learnt from, at most: a learner that shares the renderer's cores waits for new ones, a
    graphics card does not. Where both take turns, exactly so often."""

    def __post_init__(self) -> None:
        for name in (field.name for field in fields(self) if field.type is int):
            if getattr(self, name) < 1:
                raise QueryError(f"stream settings: {name} must be at least 1, found {getattr(self, name)}")
        for name in ("face_share", "edge_share"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise QueryError(f"stream settings: {name} must be 0 to 1, found {getattr(self, name)}")
        if self.rays not in ("auto", "values", "exits"):
            raise QueryError(f"stream settings: rays must be auto, values or exits, found {self.rays!r}")


class Box(NamedTuple):
    """The corner [3] and the longest side that positions are told relative to."""

    corner: Array
    side: float


class RowSource(Protocol):
    """Whatever hands rows to the learner: a renderer beside it, one that takes turns with it, or a file."""

    exits: bool
    """Whether rays are exits of walks rather than values."""

    def draw(self, count: int, generator: np.random.Generator) -> Batch:
        """`count` rows; raises what broke the source."""

    def where(self, number: int) -> str:
        """Words that name a query by its number."""

    def done(self) -> "SourceStatistics":
        """What the source has done so far."""

    def state(self) -> dict[str, int]:
        """What it takes to go on from here."""

    def start(self) -> None:
        """Return when rows can be drawn."""

    def stop(self) -> None:
        """End what goes on beside the learner."""


class SourceStatistics(NamedTuple):
    """Walks walked and rows rendered since the training began, and seconds spent walking since the source was made."""

    walks: int
    rows: int
    walking: float


class RowTracer(Protocol):
    """Path traces numbered queries to rows."""

    exits: bool
    walks_per_query: int
    """May be set to less, down to `fewest`, and back."""
    fewest: int

    def render(self, first: int, count: int) -> Batch:
        """The rows of queries number first … first + count − 1."""

    def where(self, number: int) -> str:
        """Words that name a query by its number."""


class ValueTracer:
    """Rows whose rays are values: D directions of incidence that share the query's walks."""

    exits = False

    def __init__(self, prepared: PreparedScene, box: Box, settings: StreamSettings, seed: int) -> None:
        """Queries and walks depend on the seed and the query's number alone."""
        self.walks_per_query = self.fewest = settings.walks
        self._prepared, self._box, self._settings, self._seed = prepared, box, settings, seed
        self._source = QuerySource(prepared, settings.directions, seed, settings.face_share, settings.edge_share)

    def render(self, first: int, count: int) -> Batch:
        """Rows of D rays."""
        queries = self._source.draw(first, count)
        mean, _ = render(
            self._prepared, self._source, queries, self._settings.walks, self._settings.connections, self._seed
        )
        return build_batch(queries.keys, queries.positions, queries.outgoing, queries.incident, mean, self._box)

    def where(self, number: int) -> str:
        """Words that name a query by its number."""
        return query_description(self._source, number)


class ExitTracer:
    """Rows whose rays are exits: the ends of the query's walks, told by some of them that stand for all."""

    exits = True

    def __init__(self, prepared: PreparedScene, box: Box, settings: StreamSettings, seed: int) -> None:
        """Queries and walks depend on the seed and the query's number alone."""
        self.walks_per_query, self._kept = settings.exits, settings.kept
        self.fewest = min(settings.least_exits, settings.exits)
        self._prepared, self._box, self._seed = prepared, box, seed
        self._source = QuerySource(prepared, 1, seed, settings.face_share, settings.edge_share)

    def render(self, first: int, count: int) -> Batch:
        """Rows of `kept` rays."""
        from prt_bake.trainer.samples.resampling import resampled

        queries = self._source.draw(first, count)
        exits = trace_exits(self._prepared, self._source, queries, self.walks_per_query, self._seed)
        directions, carried = exits.directions, np.where(exits.unscattered[..., None], 0.0, exits.throughput)
        if self._kept != self.walks_per_query:
            directions, carried = resampled(directions, carried, self._kept, self._seed, queries.keys)
        return build_batch(queries.keys, queries.positions, queries.outgoing, directions, carried, self._box)

    def where(self, number: int) -> str:
        """Words that name a query by its number."""
        return query_description(self._source, number)


def row_tracer(
    scene: Scene, prepared: PreparedScene, box: Box, settings: StreamSettings, seed: int
) -> ValueTracer | ExitTracer:
    """The walks whose rays `settings` ask for; raises QueryError for values behind a smooth interface."""
    smooth = smooth_part(scene)
    if settings.rays == "values" and smooth is not None:
        raise QueryError(
            f"{scene.path}: the boundary of '{smooth.name}' is smooth, and behind it Ŝ has no values at given "
            "directions; let rays be exits"
        )
    values = settings.rays == "values" or (settings.rays == "auto" and is_unbent(scene))
    return (ValueTracer if values else ExitTracer)(prepared, box, settings, seed)


def build_batch(
    numbers: NDArray[Any],
    positions: Array,
    outgoing: NDArray[Any],
    directions: NDArray[Any],
    channels: NDArray[Any],
    box: Box,
) -> Batch:
    """Rows of N queries, numbers [N], positions [N,3], outgoing [N,3], with rays along directions [N,R,3] that carry
    channels [N,R,3].
    """
    count, rays = directions.shape[:2]
    rows = np.empty((count, BEFORE_RAYS + RAY_SIZE * rays), np.float32)
    rows[:, POSITION] = (positions - box.corner) / box.side
    rows[:, OUTGOING] = outgoing
    each = rays_of(rows)
    each[..., INCIDENT], each[..., CHANNELS] = directions, channels
    return Batch(rows, np.asarray(numbers).astype(np.int64))


def query_description(source: QuerySource, number: int) -> str:
    """Words that name a query by its number."""
    location: Location = source.draw(number, 1).location
    return f"query {number} of seed {source.seed}, on face {int(location.faces[0])}"


def render(
    prepared: PreparedScene, source: QuerySource, queries: Queries, walks: int, connections: int, seed: int
) -> tuple[Array, Array]:
    """Ŝ [N,D,3] of queries and its standard error (NaN for a single walk)."""
    from prt_bake.tracer.kernels import sum_transport

    count, directions = queries.incident.shape[:2]
    chunks = np.stack([np.arange(count), np.zeros(count, int), np.full(count, walks)], axis=1)
    sums = np.zeros((count, 4, directions * 3 + 4))
    placed: tuple[Any, ...] = source.for_kernel(queries)
    in_threads(
        sum_transport,
        count,
        prepared.boundary,
        prepared.medium,
        placed,
        chunks,
        queries.incident,
        connections,
        prepared.aims,
        seed,
        sums,
    )
    mean = sums[:, 0, :-4] / walks
    with np.errstate(invalid="ignore", divide="ignore"):
        error = (
            np.sqrt(np.maximum(sums[:, 1, :-4] / walks - mean**2, 0.0) / (walks - 1)) if walks > 1 else mean * np.nan
        )
    return mean.reshape(count, directions, 3), error.reshape(count, directions, 3)


def trace_exits(prepared: PreparedScene, source: QuerySource, queries: Queries, walks: int, seed: int) -> Exits:
    """Where `walks` walks from each query leave the object."""
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
