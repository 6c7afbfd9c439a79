"""Finished blocks of a long piece of work, kept beside its output until that is written: what a restart goes on from.

A folder NAME.journal with what the work was (`identity.json`) and one file a block. Each block appears whole, by
rename, so that a process can be killed at any moment.
"""

import json
import os
import shutil
import zipfile
from collections.abc import Mapping
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.errors import StorageError
from formats.whole import remove_parts, replacing, storage_error

_IDENTITY = "identity.json"


class Journal:
    """Blocks of named arrays by name, in a folder beside `output`."""

    def __init__(self, output: str | os.PathLike[str], identity: Mapping[str, Any], resume: bool) -> None:
        """Opens the journal of `output`, an empty one unless `resume`; the folder is made with the first block.

        Attributes:
            resumed: whether there are blocks of an earlier run.

        Args:
            output: the file that the blocks are for.
            identity: all that the blocks' numbers depend on, plain JSON values.
            resume: keep the blocks of an earlier run of the same identity.

        Raises:
            StorageError: an older folder cannot be removed, or the earlier run was of another identity: says what
                changed.
        """
        self._output = Path(output)
        self.folder = self._output.with_name(f"{self._output.name}.journal")
        self._identity = json.loads(json.dumps(dict(identity)))
        self._lock = Lock()
        self.resumed = resume and (self.folder / _IDENTITY).is_file()
        if self.resumed:
            self._refuse_changed()
            remove_parts(self._output.parent, self._output.name)
            remove_parts(self.folder)
        elif self.folder.exists():
            try:
                shutil.rmtree(self.folder)
            except OSError as cause:
                raise storage_error(self.folder, cause) from cause

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
        """Removes the journal; the work is done."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _begin(self) -> None:
        """Makes the folder with the first block: where nothing was done nothing is left behind."""
        with self._lock:
            if (self.folder / _IDENTITY).is_file():
                return
            try:
                self.folder.mkdir(exist_ok=True)
            except OSError as cause:
                raise storage_error(self.folder, cause) from cause
            with replacing(self.folder / _IDENTITY) as part:
                part.write_text(json.dumps(self._identity, indent=1), encoding="utf-8")

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
