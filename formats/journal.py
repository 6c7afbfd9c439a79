"""The checkpoint store of a long computation: finished blocks, kept beside the output until it is written.

The folder NAME.journal holds the settings of the computation (`identity.json`), one file per block, and a lock file
that is held while the store is open. Each block is written atomically, so a process can be killed at any moment.

No library: caches such as joblib's and diskcache unpickle what they read, and do not name the setting that changed.
"""

import contextlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from threading import Lock
from types import TracebackType
from typing import Any, Self

import numpy as np
from filelock import FileLock, Timeout
from numpy.typing import NDArray

from formats.atomic import refuse_unwritable, remove_parts, replacing, storage_error
from formats.errors import FormatError, StorageError
from formats.npz import read_arrays

_IDENTITY, _LOCK = "identity.json", "lock"


def journal_folder(output: str | os.PathLike[str]) -> Path:
    """Return the folder of the blocks for `output`: NAME.journal beside it."""
    return Path(output).with_name(f"{Path(output).name}.journal")


def acquired(path: Path, taken: str) -> FileLock:
    """Return the lock of the file `path`, acquired, unless the file system has no locks.

    Raises StorageError, with the message `taken` if another process has it.
    """
    lock = FileLock(path, timeout=0)
    try:
        lock.acquire()
    except Timeout:
        raise StorageError(taken) from None
    except NotImplementedError:
        pass
    except OSError as cause:
        raise storage_error(path.parent, cause) from cause
    return lock


class Journal:
    """Named blocks of named arrays, in a folder beside `output` that is locked until the context ends.

    Attributes:
        folder: where the blocks are stored.
        resumed: whether blocks of an earlier run were found.
    """

    def __init__(self, output: str | os.PathLike[str], identity: Mapping[str, Any], resume: bool) -> None:
        """Open the store of `output`; it starts empty unless `resume`.

        Args:
            output: the file that the blocks are for.
            identity: everything that the blocks depend on, plain JSON values.
            resume: keep the blocks of an earlier run with the same identity.

        Raises:
            StorageError: `output` or the folder cannot be written, the folder's path is taken by something else,
                another process writes the same output, or the identity differs (the message names the settings).
        """
        self._output = Path(output)
        self.folder = journal_folder(output)
        self._identity = json.loads(json.dumps(dict(identity), allow_nan=False))
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
        """Release the lock, and remove the folder if it holds no blocks."""
        if not self.names(""):
            self._empty()
        with contextlib.suppress(OSError):
            (self.folder / _LOCK).unlink(missing_ok=True)
            self._only.release()
            self.folder.rmdir()

    def read(self, name: str) -> dict[str, NDArray[Any]] | None:
        """Return the block of that name, or None if there is none or it is damaged."""
        try:
            return read_arrays(self.folder / f"{name}.npz")
        except FormatError:
            return None

    def write(self, name: str, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Store a block atomically; raises StorageError if the disk is full."""
        self._begin()
        with replacing(self.folder / f"{name}.npz") as part, open(part, "wb") as file:
            np.savez(file, allow_pickle=False, **dict(arrays))

    def names(self, stage: str) -> list[str]:
        """Return the names of the blocks that begin with `stage`, sorted."""
        return sorted(path.stem for path in self.folder.glob(f"{stage}*.npz"))

    def forget(self, stage: str) -> None:
        """Remove the blocks whose names begin with `stage`."""
        for name in self.names(stage):
            (self.folder / f"{name}.npz").unlink(missing_ok=True)

    def remove(self) -> None:
        """Remove all blocks, after the output was written."""
        self._empty()

    def _begin(self) -> None:
        """Write the identity with the first block."""
        with self._lock:
            if not (self.folder / _IDENTITY).is_file():
                with replacing(self.folder / _IDENTITY) as part:
                    part.write_text(json.dumps(self._identity, indent=1, allow_nan=False), encoding="utf-8")

    def _empty(self) -> None:
        """Remove every file of this class, the identity first.

        Later blocks depend on earlier ones, so a process killed here must not leave blocks that look resumable.
        """
        remove_parts(self.folder)
        try:
            for path in [self.folder / _IDENTITY, *self.folder.glob("*.npz")]:
                path.unlink(missing_ok=True)
        except OSError as cause:
            raise storage_error(self.folder, cause) from cause

    def _locked(self) -> FileLock:
        """Create the folder if needed, and return its lock, acquired."""
        try:
            self.folder.mkdir(exist_ok=True)
        except OSError as cause:
            raise storage_error(self.folder, cause) from cause
        path = self.folder / _LOCK
        return acquired(
            path,
            f"{self._output}: another process is writing it (it holds {path}); wait until that process ends, or write "
            "elsewhere",
        )

    def _refuse_foreign(self) -> None:
        """Raise StorageError if the folder's path is taken by something that this class has not written."""
        if not self.folder.exists() and not self.folder.is_symlink():
            return
        if not self.folder.is_dir():
            found = "that path is not a folder"
        else:
            foreign = [path.name for path in sorted(self.folder.iterdir()) if not _is_own(path)]
            if not foreign:
                return
            found = f"that folder holds {', '.join(foreign[:3])}"
        raise StorageError(
            f"{self.folder}: expected a free path for the checkpoints of {self._output.name}, but {found}, which no "
            f"bake has written; move it elsewhere, or write to another name"
        )

    def _refuse_changed(self) -> None:
        try:
            before = json.loads((self.folder / _IDENTITY).read_text(encoding="utf-8"))
        except ValueError:
            before = {}
        now = self._identity
        changed = sorted(key for key in now.keys() | before.keys() if now.get(key) != before.get(key))
        if changed:
            differences = "; ".join(f"{key} was {before.get(key)!r} and is {now.get(key)!r}" for key in changed)
            raise StorageError(
                f"{self._output}: cannot be resumed, because {differences}; use the settings of the earlier run, or "
                f"start again without resuming"
            )


def _is_own(path: Path) -> bool:
    """Whether `Journal` writes files of this name."""
    return path.name in (_IDENTITY, _LOCK) or path.suffix in (".npz", ".part")
