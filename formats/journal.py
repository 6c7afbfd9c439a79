"""Finished blocks of a long piece of work, kept beside its output until that is written: what a restart goes on from.

A folder NAME.journal with what the work was (`identity.json`), one file a block, and a lock that is held while one
works with it. Each block appears whole, by rename, so that a process can be killed at any moment.

No library: caches such as joblib's and diskcache unpickle what they read, and do not tell which setting has changed.
"""

import contextlib
import json
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from threading import Lock
from types import TracebackType
from typing import Any, Self

import numpy as np
from filelock import FileLock, Timeout
from numpy.typing import NDArray

from formats.atomic import refuse_unwritable, remove_parts, replacing, storage_error
from formats.errors import StorageError

_IDENTITY, _LOCK = "identity.json", "lock"


def journal_folder(output: str | os.PathLike[str]) -> Path:
    """Where the blocks for `output` are kept: NAME.journal beside it."""
    return Path(output).with_name(f"{Path(output).name}.journal")


class Journal:
    """Blocks of named arrays by name, in a folder beside `output`; its lock is held until the context is left."""

    def __init__(self, output: str | os.PathLike[str], identity: Mapping[str, Any], resume: bool) -> None:
        """Opens the journal of `output`, an empty one unless `resume`.

        Attributes:
            resumed: whether there are blocks of an earlier run.

        Args:
            output: the file that the blocks are for.
            identity: all that the blocks' numbers depend on, plain JSON values.
            resume: keep the blocks of an earlier run of the same identity.

        Raises:
            StorageError: `output` or the folder cannot be written, something else lies where the folder should, another
                process works for the same output, or the earlier run was of another identity: says what changed.
        """
        self._output = Path(output)
        self.folder = journal_folder(output)
        self._identity = json.loads(json.dumps(dict(identity)))
        refuse_unwritable(self._output)
        self._refuse_foreign()
        self._lock, self._only = Lock(), self._locked()
        self.resumed = resume and (self.folder / _IDENTITY).is_file()
        try:
            if self.resumed:
                self._refuse_changed()
            else:
                self._empty()
            for name in (self._output.name, f"partial-{self._output.name}"):
                remove_parts(self._output.parent, name)
            remove_parts(self.folder)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Lets go of the journal; the folder is removed where nothing is kept in it."""
        if not self.names(""):
            self._empty()
        with contextlib.suppress(OSError):
            (self.folder / _LOCK).unlink(missing_ok=True)
            self._only.release()
            self.folder.rmdir()

    def read(self, name: str) -> dict[str, NDArray[Any]] | None:
        """The block of that name, or None where there is none that can be read."""
        try:
            with open(self.folder / f"{name}.npz", "rb") as file, np.load(file, allow_pickle=False) as arrays:
                return {key: arrays[key] for key in arrays.files}
        except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile):
            return None

    def write(self, name: str, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Keeps a block; raises StorageError where the disk is full, and keeps what was there before."""
        self._begin()
        with replacing(self.folder / f"{name}.npz") as part, open(part, "wb") as file:
            np.savez(file, allow_pickle=False, **dict(arrays))

    def names(self, stage: str) -> list[str]:
        """Names of the blocks that begin with `stage`."""
        return sorted(path.stem for path in self.folder.glob(f"{stage}*.npz"))

    def forget(self, stage: str) -> None:
        """Removes the blocks whose names begin with `stage`."""
        for name in self.names(stage):
            (self.folder / f"{name}.npz").unlink(missing_ok=True)

    def remove(self) -> None:
        """Removes all blocks; the work is done."""
        self._empty()

    def _begin(self) -> None:
        """Says what the work is, with the first block."""
        with self._lock:
            if not (self.folder / _IDENTITY).is_file():
                with replacing(self.folder / _IDENTITY) as part:
                    part.write_text(json.dumps(self._identity, indent=1), encoding="utf-8")

    def _empty(self) -> None:
        """Removes what this class has written, the identity first: a part of the blocks is nothing to go on from, since
        later ones are made of earlier ones.
        """
        remove_parts(self.folder)
        try:
            for path in [self.folder / _IDENTITY, *self.folder.glob("*.npz")]:
                path.unlink(missing_ok=True)
        except OSError as cause:
            raise storage_error(self.folder, cause) from cause

    def _locked(self) -> FileLock:
        """The folder, made where there is none, and its lock, held."""
        lock = FileLock(self.folder / _LOCK, timeout=0)
        try:
            self.folder.mkdir(exist_ok=True)
            lock.acquire()
        except Timeout:
            raise StorageError(
                f"{self._output}: another process is at work on it (it holds {self.folder / _LOCK}); wait until that "
                f"has ended, or write elsewhere"
            ) from None
        except NotImplementedError:  # a file system without locks
            pass
        except OSError as cause:
            raise storage_error(self.folder, cause) from cause
        return lock

    def _refuse_foreign(self) -> None:
        """Raise StorageError where there is anything in the way that this class has not written."""
        if not self.folder.exists() and not self.folder.is_symlink():
            return
        if not self.folder.is_dir():
            found = "is no folder"
        else:
            strange = [path.name for path in sorted(self.folder.iterdir()) if not _own(path)]
            if not strange:
                return
            found = f"holds {', '.join(strange[:3])}"
        raise StorageError(
            f"{self.folder}: finished blocks of {self._output.name} would be kept there, but it {found}, which no bake "
            f"has left; move it elsewhere, or write to another name"
        )

    def _refuse_changed(self) -> None:
        own = self._identity
        try:
            before = json.loads((self.folder / _IDENTITY).read_text(encoding="utf-8"))
        except ValueError:
            before = {}
        changed = sorted(key for key in own.keys() | before.keys() if own.get(key) != before.get(key))
        if changed:
            said = "; ".join(f"{key} was {before.get(key)!r} and is {own.get(key)!r}" for key in changed)
            raise StorageError(
                f"{self._output}: cannot be resumed, since {said}; give what it was begun with, or start anew without "
                f"resuming"
            )


def _own(path: Path) -> bool:
    """Whether a file in a journal's folder is one that it writes."""
    return path.name in (_IDENTITY, _LOCK) or path.suffix in (".npz", ".part")
