"""What a bake keeps of its finished blocks while it runs: in a journal beside the asset, or in memory."""

from pathlib import Path
from typing import Any, Protocol

from numpy.typing import NDArray

from formats.journal import Journal


class Store(Protocol):
    """Keeps named arrays by name: in memory, or `formats.journal.Journal`."""

    def read(self, name: str) -> dict[str, NDArray[Any]] | None:
        """What was kept under that name."""

    def write(self, name: str, arrays: dict[str, NDArray[Any]]) -> None:
        """Keeps arrays."""

    def names(self, stage: str) -> list[str]:
        """The names that begin so."""

    def forget(self, stage: str) -> None:
        """Drops what is kept under names that begin so."""

    def remove(self) -> None:
        """Drops everything."""

    def close(self) -> None:
        """Lets go of what is kept."""


class Memory:
    """A store in memory."""

    def __init__(self) -> None:
        self._kept: dict[str, dict[str, NDArray[Any]]] = {}

    def read(self, name: str) -> dict[str, NDArray[Any]] | None:
        """What was kept under that name."""
        return self._kept.get(name)

    def write(self, name: str, arrays: dict[str, NDArray[Any]]) -> None:
        """Keeps arrays."""
        self._kept[name] = arrays

    def names(self, stage: str) -> list[str]:
        """The names that begin so."""
        return sorted(name for name in self._kept if name.startswith(stage))

    def forget(self, stage: str) -> None:
        """Drops what is kept under names that begin so."""
        for name in self.names(stage):
            del self._kept[name]

    def remove(self) -> None:
        """Drops everything."""
        self._kept.clear()

    def close(self) -> None:
        """Nothing is held."""


def opened_store(out: str | Path | None, identity: dict[str, Any], resume: bool) -> Store:
    """A journal beside the asset, or memory where there is no asset on disk."""
    return Memory() if out is None else Journal(out, identity, resume)
