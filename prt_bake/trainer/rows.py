"""What the learner learns from: rows of numbers that walks have filled in.

A row is a direction of incidence, a position relative to the box, a direction to the eye and three channels. Of a
scene with point values the channels are Ŝ towards the direction. Behind a smooth interface no such values exist; there
the direction is one in which a walk left, and the channels are the throughput that it carried out (0 for a walk that
was absorbed or that met nothing, since that light is not in Ŝ).
"""

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from prt_bake.surface import Location
from prt_bake.trainer.lit import Exits
from prt_bake.trainer.prepared import PreparedScene
from prt_bake.trainer.queries import Queries, QuerySource

Array = NDArray[np.float64]

INCIDENT, POSITION, OUTGOING, CHANNELS = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
ROW_SIZE = 12


class Batch(NamedTuple):
    """Rows [M,12] float32, and the numbers [M] int64 of the queries that they belong to."""

    rows: NDArray[np.float32]
    numbers: NDArray[np.int64]


@dataclass(frozen=True)
class StreamSettings:
    """How the renderer asks; chosen by measured error after equal time (`make bench`)."""

    queries_a_batch: int = 4096
    directions: int = 8
    """Directions of incidence a query; behind a smooth interface there are none to choose."""
    walks: int = 1
    """Walks a query; behind a smooth interface each is a row of its own."""
    connections: int = 4
    capacity: int = 1 << 20
    """Rows that the buffer holds."""
    reuse: int = 1
    """How often each row is learnt from where renderer and learner take turns."""


class Box(NamedTuple):
    """The corner [3] and the longest side that positions are told relative to."""

    corner: Array
    side: float


class RowSource(Protocol):
    """Whatever hands rows to the learner: a renderer beside it, one that takes turns with it, or a file."""

    exits: bool
    """Whether rows are exits of walks rather than values."""

    def draw(self, count: int, generator: np.random.Generator) -> Batch:
        """`count` rows; raises what broke the source."""

    def where(self, number: int) -> str:
        """Words that name a query by its number."""

    def done(self) -> "Done":
        """What the source has done so far."""

    def state(self) -> dict[str, int]:
        """What it takes to go on from here."""

    def start(self) -> None:
        """Return when rows can be drawn."""

    def stop(self) -> None:
        """End what goes on beside the learner."""


class Done(NamedTuple):
    """Walks walked and rows rendered since the training began, and seconds spent walking since the source was made."""

    walks: int
    rows: int
    walking: float


class RowWalks(Protocol):
    """Path traces numbered queries to rows."""

    exits: bool
    rows_a_query: int
    walks_a_query: int

    def render(self, first: int, count: int) -> Batch:
        """The rows of queries number first … first + count − 1, query by query."""

    def where(self, number: int) -> str:
        """Words that name a query by its number."""


class ValueWalks:
    """Rows of Ŝ: each query with D directions that share its walks."""

    exits = False

    def __init__(self, prepared: PreparedScene, box: Box, settings: StreamSettings, seed: int) -> None:
        """Queries and walks depend on the seed and the query's number alone."""
        self.rows_a_query, self.walks_a_query = settings.directions, settings.walks
        self._prepared, self._box, self._settings, self._seed = prepared, box, settings, seed
        self._source = QuerySource(prepared, settings.directions, seed)

    def render(self, first: int, count: int) -> Batch:
        """The rows [count · D, 12] of `count` queries."""
        queries = self._source.draw(first, count)
        mean, _ = render(
            self._prepared, self._source, queries, self._settings.walks, self._settings.connections, self._seed
        )
        return batch_of(queries.keys, queries.positions, queries.outgoing, queries.incident, mean, self._box)

    def where(self, number: int) -> str:
        """Words that name a query by its number."""
        return _where(self._source, number)


class ExitWalks:
    """Rows of exits: each query with the ends of its walks."""

    exits = True

    def __init__(self, prepared: PreparedScene, box: Box, settings: StreamSettings, seed: int) -> None:
        """Queries and walks depend on the seed and the query's number alone."""
        self.rows_a_query = self.walks_a_query = settings.walks
        self._prepared, self._box, self._seed = prepared, box, seed
        self._source = QuerySource(prepared, 1, seed)

    def render(self, first: int, count: int) -> Batch:
        """The rows [count · walks, 12] of `count` queries."""
        queries = self._source.draw(first, count)
        exits = render_exits(self._prepared, self._source, queries, self.walks_a_query, self._seed)
        carried = np.where(exits.unscattered[..., None], 0.0, exits.throughput)
        return batch_of(queries.keys, queries.positions, queries.outgoing, exits.directions, carried, self._box)

    def where(self, number: int) -> str:
        """Words that name a query by its number."""
        return _where(self._source, number)


def batch_of(
    numbers: NDArray[Any],
    positions: Array,
    outgoing: NDArray[Any],
    incident: NDArray[Any],
    channels: NDArray[Any],
    box: Box,
) -> Batch:
    """Rows of N queries: numbers [N], positions [N,3], outgoing [N,3], incident [N,D,3] and channels [N,D,3]."""
    rows = np.empty((*incident.shape[:2], ROW_SIZE), np.float32)
    rows[..., INCIDENT] = incident
    rows[..., POSITION] = ((positions - box.corner) / box.side)[:, None]
    rows[..., OUTGOING] = outgoing[:, None]
    rows[..., CHANNELS] = channels
    return Batch(rows.reshape(-1, ROW_SIZE), np.repeat(np.asarray(numbers).astype(np.int64), incident.shape[1]))


def _where(source: QuerySource, number: int) -> str:
    location: Location = source.draw(number, 1).location
    return f"query {number} of seed {source.seed}, on face {int(location.faces[0])}"


def render(
    prepared: PreparedScene, source: QuerySource, queries: Queries, walks: int, connections: int, seed: int
) -> tuple[Array, Array]:
    """Ŝ [N,D,3] of queries and its standard error (NaN for a single walk)."""
    from prt_bake.trainer.kernels import sum_transport

    count, directions = queries.incident.shape[:2]
    chunks = np.stack([np.arange(count), np.zeros(count, int), np.full(count, walks)], axis=1)
    sums = np.zeros((count, 4, directions * 3 + 4))
    placed: tuple[Any, ...] = source.for_kernel(queries)
    sum_transport(
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


def render_exits(prepared: PreparedScene, source: QuerySource, queries: Queries, walks: int, seed: int) -> Exits:
    """Where `walks` walks from each query leave the object."""
    from prt_bake.trainer.kernels import draw_exits

    count = len(queries.keys)
    directions, throughput = np.zeros((count, walks, 3)), np.zeros((count, walks, 3))
    scattered = np.zeros((count, walks), np.int64)
    draw_exits(
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
