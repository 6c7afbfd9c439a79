"""A folder of what was made, each file with what it was made from: work is done once, and again only for other inputs.

Beside NAME lies NAME.made.json: the inputs, the facts that the work reported (seconds, walks, …) and the file's hash.
A file without it, of other inputs, or altered since, is made anew.
"""

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from formats.atomic import replacing, sha256
from formats.errors import PrtbakeError, StorageError

Facts = dict[str, Any]
Say = Callable[[str], None]


class Stopped(PrtbakeError):
    """The work was asked to stop; what was made so far is kept."""


@dataclass(frozen=True)
class Artefact:
    """A file that was made, its SHA-256, and what the work reported of it."""

    path: Path
    sha256: str
    facts: Facts


class Artefacts:
    """Files made once under a folder; `say` is told what is made, and why anew."""

    def __init__(self, folder: Path, say: Say, stop: Callable[[], bool] = lambda: False) -> None:
        """Make the folder where it is missing; raises StorageError where it cannot be made."""
        self.folder, self.say, self._stop = folder, say, stop
        _make_folder(folder)

    def make(self, name: str, inputs: Facts, build: Callable[[Path], Facts | None]) -> Artefact:
        """The file `name`, made by `build(path)` unless it is there of the same `inputs` (plain JSON values).

        Raises Stopped, before any work, where the work was asked to stop.
        """
        path = self.folder / name
        kept = self.find(name, inputs)
        if kept is not None:
            return kept
        self.check()
        _make_folder(path.parent)
        self.say(f"{name}: {self._reason(name, inputs)}")
        begun = time.perf_counter()
        facts = dict(build(path) or {})
        facts.setdefault("seconds", time.perf_counter() - begun)
        return self.record(name, inputs, facts)

    def find(self, name: str, inputs: Facts) -> Artefact | None:
        """The file `name` where it is there, unaltered and of the same inputs."""
        path, record = self.folder / name, self._record(name)
        if record is None or not path.is_file() or record["inputs"] != _plain(inputs):
            return None
        digest = sha256(path)
        return Artefact(path, digest, record["facts"]) if digest == record["sha256"] else None

    def record(self, name: str, inputs: Facts, facts: Facts) -> Artefact:
        """Note what the file `name`, which is there, was made from."""
        path = self.folder / name
        artefact = Artefact(path, sha256(path), _plain(facts))
        record = {"inputs": inputs, "facts": facts, "sha256": artefact.sha256}
        with replacing(_beside(path)) as part:
            part.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
        return artefact

    def check(self) -> None:
        """Raise Stopped where the work was asked to stop."""
        if self._stop():
            raise Stopped("the work was stopped; the same command goes on from what is made")

    @property
    def stop(self) -> Callable[[], bool]:
        """Whether the work was asked to stop."""
        return self._stop

    def _record(self, name: str) -> dict[str, Any] | None:
        try:
            record = json.loads(_beside(self.folder / name).read_text(encoding="utf-8"))
            return record if {"inputs", "facts", "sha256"} <= set(record) else None
        except (OSError, ValueError, TypeError):
            return None

    def _reason(self, name: str, inputs: Facts) -> str:
        record = self._record(name)
        if record is None or not (self.folder / name).is_file():
            return "to be made"
        wanted, found = _plain(inputs), record["inputs"]
        changed = sorted(key for key in wanted.keys() | found.keys() if wanted.get(key) != found.get(key))
        return f"made anew, another {', '.join(changed)}" if changed else "made anew, the file was altered"


def _beside(path: Path) -> Path:
    return path.with_name(path.name + ".made.json")


def _plain(values: Facts) -> Facts:
    """As JSON keeps them: tuples become lists."""
    plain: Facts = json.loads(json.dumps(values))
    return plain


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as cause:
        raise StorageError(f"{folder}: cannot be made: {cause.strerror}; choose another --out") from cause
