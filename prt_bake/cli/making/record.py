"""What `prtbake make` has done in a folder: `summary.json`, written after every step."""

import contextlib
import json
import math
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Self

from formats.errors import FormatError, StorageError
from formats.journal import acquired, journal_folder
from formats.json_report import write_report
from prt_bake.cli.shared.progress import in_words, say
from prt_bake.inspection.overview import in_bytes
from prt_bake.network.file_names import importance_path, report_paths, state_path

MODEL, ASSET, COMPACT = "model.pt", "asset.h5", "compact.h5"
PICTURE, TURNTABLE = "picture.png", "turntable.webp"
SUMMARY, PAGE = "summary.json", "summary.md"
USUAL_MINUTES = 20.0
_LOCK = "make.lock"
PICTURES = ("picture", "turntable")
"""The steps that depend on the settings of the pictures."""


@dataclass(frozen=True)
class Step:
    """A step: the command that does it by hand, its seconds, its files with their bytes; or why it was left out."""

    name: str
    command: str
    seconds: float
    files: dict[str, int]
    note: str = ""


@dataclass
class Record:
    """The settings and finished steps of a folder.

    Attributes:
        folder: where everything is written.
        settings: what all files depend on: the "scene", its "scene_hash", its "keys", such as "medium.density", and the
            "start_hash" of --from.
        pictures: what the pictures depend on as well: their "light" in words, hashes of its files, and "options" of
            `prtbake shade`.
        minutes: time of everything that is made in the folder, by however many runs.
        spent: seconds of all runs so far.
        steps: the finished ones.
        unfinished: seconds that interrupted runs gave to a step that can be resumed.
        figures: errors and counts of the result.
    """

    folder: Path
    settings: dict[str, Any]
    pictures: dict[str, Any]
    minutes: float = USUAL_MINUTES
    spent: float = 0.0
    steps: list[Step] = field(default_factory=list)
    unfinished: dict[str, float] = field(default_factory=dict)
    figures: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def open(
        cls, folder: Path, settings: Mapping[str, Any], pictures: Mapping[str, Any], minutes: float | None, force: bool
    ) -> Self:
        """Return the record of a folder, or begin one.

        Without `minutes` a folder keeps its time. With as much again as its steps took the training continues, and what
        follows is made again; with less more its model and its asset stay. Other pictures are made again alone. Raises
        StorageError if the folder holds files of these names that are of other settings, or were not made by `prtbake
        make`, unless `force`, which removes them.
        """
        if force:
            for path in _all_files(folder):
                shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
        if (folder / SUMMARY).is_file():
            record = cls._read(folder, dict(settings))
            record._extend(minutes)
            record._change_pictures(dict(pictures))
        else:
            refuse_foreign(folder)
            record = cls(folder, dict(settings), dict(pictures), minutes or USUAL_MINUTES)
        record.write()
        return record

    @classmethod
    def _read(cls, folder: Path, wanted: dict[str, Any]) -> Self:
        path = folder / SUMMARY
        again = "choose another folder, or add --force to make everything again"
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            steps = [Step(**step) for step in content.pop("steps")]
            record = cls(folder, steps=steps, **content)
        except (ValueError, KeyError, TypeError, AttributeError) as cause:
            raise FormatError(f"{path}: was not written by `prtbake make`, or is damaged; {again}") from cause
        if (scene := record.settings.get("scene")) != wanted["scene"]:
            raise StorageError(f"{folder}: was made with scene {scene!r}, found {wanted['scene']!r}; {again}")
        before, now = record.settings.get("keys", {}), wanted["keys"]
        up = "object.up"  # of the asset and the pictures, though not of the hash
        if record.settings.get("scene_hash") != wanted["scene_hash"] or (up in before and before[up] != now[up]):
            raise StorageError(
                f"{folder}: {scene} has changed since it was made: {_changes(before, now)}; choose another folder, "
                f"where --from {folder / MODEL} saves most of the training, or add --force to make everything again"
            )
        if record.settings.get("start_hash") != wanted["start_hash"]:
            raise StorageError(f"{folder}: was made with another --from, or without it; give the same, or {again}")
        return record

    def _extend(self, minutes: float | None) -> None:
        if minutes is None or minutes == self.minutes:
            return
        if minutes < self.minutes:
            raise StorageError(
                f"{self.folder}: was made for {self.minutes:g} minutes, found --minutes {minutes:g}; omit it to keep "
                "the time, ask for more to train on, or add --force to make everything again"
            )
        if 60.0 * minutes <= self.spent:
            raise StorageError(
                f"{self.folder}: has taken {in_words(self.spent)} already, found --minutes {minutes:g}; ask for "
                "more, or omit it"
            )
        self.minutes = minutes
        enough = math.ceil((self.spent + sum(step.seconds for step in self.steps)) / 60.0)
        if minutes < enough:
            say(
                f"{self.folder}: --minutes {minutes:g} is too short to train on and bake again, so its model and its "
                f"asset stay; ask for {enough} or more to train on"
            )
            return
        self.unfinished |= {step.name: step.seconds for step in self.steps if step.name == "train"}
        self.steps = []

    def _change_pictures(self, pictures: dict[str, Any]) -> None:
        if pictures != self.pictures:
            self.pictures = pictures
            self.steps = [step for step in self.steps if step.name not in PICTURES]

    def finished(self, name: str) -> Step | None:
        """Return the step if it is finished, was not left out, and its files are as it left them."""
        for step in self.steps:
            if (
                step.name == name
                and not step.note
                and all(_size(self.folder / file) == size for file, size in step.files.items())
            ):
                return step
        return None

    def add(self, name: str, command: str, seconds: float, files: list[str], note: str = "") -> None:
        """Record a finished step; of `files`, those that exist."""
        sizes = {file: size for file in files if (size := _size(self.folder / file)) is not None}
        self.steps = [step for step in self.steps if step.name != name]
        self.steps.append(Step(name, command, round(seconds, 1), sizes, note))
        self.write()

    @property
    def kept(self) -> float:
        """Seconds of all runs that went into finished steps, or into a training that can be resumed."""
        return sum(step.seconds for step in self.steps) + self.unfinished.get("train", 0.0)

    def sizes(self) -> dict[str, str]:
        """The files of the finished steps, each with its size in words."""
        return {file: in_bytes(size) for step in self.steps for file, size in step.files.items()}

    def write(self) -> None:
        """Write `summary.json`."""
        content = {
            "settings": self.settings,
            "pictures": self.pictures,
            "minutes": self.minutes,
            "spent": round(self.spent, 1),
            "figures": self.figures,
            "steps": [asdict(step) for step in self.steps],
            "unfinished": self.unfinished,
        }
        write_report(content, self.folder / SUMMARY)


@contextmanager
def only_run(folder: Path) -> Iterator[None]:
    """Context in which no other `prtbake make` works in the folder. Raises StorageError if one does."""
    taken = f"{folder}: another `prtbake make` works in this folder; wait until it ends, or choose another folder"
    lock = acquired(folder / _LOCK, taken)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            (folder / _LOCK).unlink(missing_ok=True)
        lock.release()


def refuse_foreign(folder: Path) -> None:
    """Raise StorageError if the folder has no summary, but files of the names that `prtbake make` writes."""
    if not (folder / SUMMARY).is_file() and (found := [path for path in _all_files(folder) if path.exists()]):
        raise StorageError(f"{found[0]}: already exists; choose another folder, or add --force to replace it")


def _changes(before: dict[str, Any], now: dict[str, Any]) -> str:
    """Name the keys of a scene that differ; if none does, a file that they name has changed."""
    names = [name for name in before | now if before.get(name) != now.get(name)] if before else []
    words = (f"{name} was {before.get(name, 'left out')}, is {now.get(name, 'left out')}" for name in names)
    return ", ".join(words) or "a key, or a file that it names, such as the mesh"


def model_files() -> list[str]:
    """Return the names of the files that a training leaves: the model, its report and its importance module."""
    return [MODEL, *(path.name for path in report_paths(MODEL)), importance_path(MODEL).name]


def all_names() -> list[str]:
    """Return the names of all files that `prtbake make` may write."""
    return [*model_files(), state_path(MODEL).name, ASSET, COMPACT, PICTURE, TURNTABLE, PAGE, SUMMARY]


def _all_files(folder: Path) -> list[Path]:
    return [*(folder / name for name in all_names()), journal_folder(folder / ASSET)]


def _size(path: Path) -> int | None:
    return path.stat().st_size if path.is_file() else None
