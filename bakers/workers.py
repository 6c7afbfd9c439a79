"""Workers of a bake: threads of this process, or a cluster."""

from collections.abc import Callable, Generator, Iterable
from typing import Any, Protocol, TypeVar

from numpy.typing import NDArray

from bakers.in_order import in_order

Item = TypeVar("Item")
Result = TypeVar("Result")


class Workers(Protocol):
    """Runs parts of a bake in parallel; the results do not depend on the number of workers."""

    @property
    def count(self) -> int:
        """Number of items that run at the same time."""

    def in_order(self, work: Callable[[Item], Result], items: Iterable[Item]) -> Generator[Result, None, None]:
        """Yields work(item) for every item, in order; `work` runs here, in a thread, and may `do` its heavy part."""

    def do(self, work: Callable[..., Result], shared: tuple[Any, ...], *own: Any) -> Result:
        """work(*shared, *own), wherever a worker is free. `work` is a module-level function; `shared` holds arguments
        that many calls have in common and that never change.
        """


def split_evenly(items: NDArray[Any], most: int, workers: Workers) -> list[NDArray[Any]]:
    """Splits items [n] into pieces of at most `most`, and into at least one piece per worker if there are enough."""
    size = max(1, min(most, -(-len(items) // workers.count)))
    return [items[first : first + size] for first in range(0, len(items), size)]


class Threads:
    """Threads of this process."""

    def __init__(self, workers: int) -> None:
        self.count = workers

    def in_order(self, work: Callable[[Item], Result], items: Iterable[Item]) -> Generator[Result, None, None]:
        """As many items at a time as there are workers."""
        return in_order(work, items, self.count)

    def do(self, work: Callable[..., Result], shared: tuple[Any, ...], *own: Any) -> Result:
        """work(*shared, *own), immediately."""
        return work(*shared, *own)


SINGLE_THREAD = Threads(1)
"""The calling thread."""
