"""Who does the work of a bake: threads of this process, or whoever else is handed it."""

from collections.abc import Callable, Generator, Iterable
from typing import Any, Protocol, TypeVar

from numpy.typing import NDArray

from bakers.in_order import in_order

Item = TypeVar("Item")
Result = TypeVar("Result")


class Crew(Protocol):
    """Does parts of a bake, several at a time; what it gives back does not depend on how many are at it."""

    @property
    def workers(self) -> int:
        """How many work at the same time."""

    def in_order(self, work: Callable[[Item], Result], items: Iterable[Item]) -> Generator[Result, None, None]:
        """Yields work(item) for every item, in order; `work` runs here, in a thread, and may `do` its heavy part."""

    def do(self, work: Callable[..., Result], shared: tuple[Any, ...], *own: Any) -> Result:
        """work(*shared, *own), wherever that is done. `work` is a function of a module, `shared` what many calls have
        in common, and is never changed.
        """


def pieces(whole: NDArray[Any], most: int, crew: Crew) -> list[NDArray[Any]]:
    """A short piece of work cut so that all of a crew are at it: [n] in pieces of at most `most`."""
    size = max(1, min(most, -(-len(whole) // crew.workers)))
    return [whole[first : first + size] for first in range(0, len(whole), size)]


class Threads:
    """Threads of this process."""

    def __init__(self, workers: int) -> None:
        self.workers = workers

    def in_order(self, work: Callable[[Item], Result], items: Iterable[Item]) -> Generator[Result, None, None]:
        """As many items at a time as there are workers."""
        return in_order(work, items, self.workers)

    def do(self, work: Callable[..., Result], shared: tuple[Any, ...], *own: Any) -> Result:
        """work(*shared, *own), at once."""
        return work(*shared, *own)


ALONE = Threads(1)
"""The thread that asks."""
