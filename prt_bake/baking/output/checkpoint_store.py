"""Stores for the finished blocks of a bake in progress: a journal beside the asset, or memory."""

from pathlib import Path
from typing import Any, Protocol

from numpy.typing import NDArray

from formats.journal import Journal


class CheckpointStore(Protocol):
    """Stores groups of arrays by name; `formats.journal.Journal` is one."""

    def read(self, name: str) -> dict[str, NDArray[Any]] | None:
        """The arrays of that name; None if there are none, or they are damaged."""

    def write(self, name: str, arrays: dict[str, NDArray[Any]]) -> None:
        """Stores arrays under a name."""

    def names(self, stage: str) -> list[str]:
        """The names that begin with the prefix."""

    def forget(self, stage: str) -> None:
        """Deletes all arrays whose names begin with the prefix."""

    def remove(self) -> None:
        """Deletes everything."""

    def close(self) -> None:
        """Releases the store."""


class MemoryStore:
    """A store in memory."""

    def __init__(self) -> None:
        self._arrays: dict[str, dict[str, NDArray[Any]]] = {}

    def read(self, name: str) -> dict[str, NDArray[Any]] | None:
        """The arrays of that name."""
        return self._arrays.get(name)

    def write(self, name: str, arrays: dict[str, NDArray[Any]]) -> None:
        """Stores arrays under a name."""
        self._arrays[name] = arrays

    def names(self, stage: str) -> list[str]:
        """The names that begin with the prefix."""
        return sorted(name for name in self._arrays if name.startswith(stage))

    def forget(self, stage: str) -> None:
        """Deletes all arrays whose names begin with the prefix."""
        for name in self.names(stage):
            del self._arrays[name]

    def remove(self) -> None:
        """Deletes everything."""
        self._arrays.clear()

    def close(self) -> None:
        """Nothing to do."""


def open_checkpoint_store(out: str | Path | None, identity: dict[str, Any], resume: bool) -> CheckpointStore:
    """A journal beside the asset `out`, or memory for a bake without a file."""
    return MemoryStore() if out is None else Journal(out, identity, resume)
