"""A folder of files, each recorded with its inputs, so that a file is built once and rebuilt only if they change.

NAME.made.json beside NAME holds the inputs, the facts that the builder returned (seconds, walks, …) and the file's
hash. A file without a record, with other inputs or with another hash is rebuilt. Facts that are NaN, such as unknown
figures, are null in the record and None in the artefact.
"""

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from formats.atomic import create_folder, replacing, sha256
from formats.errors import PrtbakeError
from formats.json_report import as_line, write_report

Facts = dict[str, Any]
Say = Callable[[str], None]


class Stopped(PrtbakeError):
    """The work was stopped by request; the files built so far are kept."""


@dataclass(frozen=True)
class Artefact:
    """A file, its SHA-256, and the facts that its builder returned."""

    path: Path
    sha256: str
    facts: Facts


class Artefacts:
    """The files of a folder; `say` prints what is built, and why."""

    def __init__(self, folder: Path, say: Say, stop: Callable[[], bool] = lambda: False) -> None:
        """Create the folder if it is missing; raises StorageError if that fails."""
        self.folder, self.say, self._stop = folder, say, stop
        create_folder(folder)

    def make(self, name: str, inputs: Facts, build: Callable[[Path], Facts | None]) -> Artefact:
        """Return the file `name`, built by `build(path)` unless it exists with the same `inputs` (plain JSON values).

        Raises Stopped, before any work, if a stop was requested.
        """
        path = self.folder / name
        found = self.find(name, inputs)
        if found is not None:
            return found
        self.check()
        create_folder(path.parent)
        self.say(f"{name}: {self._reason(name, inputs)}")
        start = time.perf_counter()
        facts = dict(build(path) or {})
        facts.setdefault("seconds", time.perf_counter() - start)
        return self.record(name, inputs, facts)

    def find(self, name: str, inputs: Facts) -> Artefact | None:
        """Return the file `name` if it exists, unaltered and with the same inputs; else None."""
        path, record = self.folder / name, self._record(name)
        if record is None or not path.is_file() or record["inputs"] != _plain(inputs):
            return None
        digest = sha256(path)
        return Artefact(path, digest, record["facts"]) if digest == record["sha256"] else None

    def record(self, name: str, inputs: Facts, facts: Facts) -> Artefact:
        """Write the record of the existing file `name`."""
        path = self.folder / name
        artefact = Artefact(path, sha256(path), _plain(facts))
        record = {"inputs": inputs, "facts": facts, "sha256": artefact.sha256}
        write_report(record, _record_path(path))
        return artefact

    def check(self) -> None:
        """Raise Stopped if a stop was requested."""
        if self._stop():
            raise Stopped("the work was stopped; the same command resumes it")

    @property
    def stop(self) -> Callable[[], bool]:
        """A function that returns whether a stop was requested."""
        return self._stop

    def _record(self, name: str) -> dict[str, Any] | None:
        try:
            text = _record_path(self.folder / name).read_text(encoding="utf-8")
            record = json.loads(text, parse_constant=lambda _nan: None)
            return record if {"inputs", "facts", "sha256"} <= set(record) else None
        except (OSError, ValueError, TypeError):
            return None

    def _reason(self, name: str, inputs: Facts) -> str:
        record = self._record(name)
        if record is None or not (self.folder / name).is_file():
            return "building"
        requested, recorded = _plain(inputs), record["inputs"]
        keys = requested.keys() | recorded.keys()
        changed = sorted(key for key in keys if requested.get(key) != recorded.get(key))
        return f"rebuilding, changed {', '.join(changed)}" if changed else "rebuilding, the file was altered"


def _record_path(path: Path) -> Path:
    return path.with_name(path.name + ".made.json")


def _plain(values: Facts) -> Facts:
    """Return the values as JSON stores them: tuples become lists, NaN becomes None."""
    plain: Facts = json.loads(as_line(values))
    return plain


def write_text(path: Path, text: str) -> None:
    """Write a text file, atomically."""
    with replacing(path) as part:
        part.write_text(text, encoding="utf-8")
