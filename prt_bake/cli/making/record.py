"""What `prtbake make` has done in a folder: `summary.json`, written after every step."""

import json
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Self

from formats.errors import FormatError, StorageError
from formats.journal import journal_folder
from formats.json_report import write_report
from prt_bake.network.file_names import importance_path, report_paths, state_path

MODEL, ASSET, COMPACT = "model.pt", "asset.h5", "compact.h5"
PICTURE, TURNTABLE = "picture.png", "turntable.webp"
SUMMARY, PAGE = "summary.json", "summary.md"


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
        settings: what the files depend on; plain JSON values.
        steps: the finished ones.
        planned: numbers that a resumed step needs again, such as the time of the bake.
        figures: errors and counts of the result.
    """

    folder: Path
    settings: dict[str, Any]
    steps: list[Step] = field(default_factory=list)
    planned: dict[str, Any] = field(default_factory=dict)
    figures: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def open(cls, folder: Path, settings: Mapping[str, Any], force: bool) -> Self:
        """Return the record of a folder, or begin one.

        Raises StorageError if the folder holds files of these names that are of other settings, or were not made by
        `prtbake make`, unless `force`, which removes them.
        """
        wanted = json.loads(json.dumps(dict(settings)))
        if force:
            for path in _all_files(folder):
                shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
        if (folder / SUMMARY).is_file():
            return cls._read(folder, wanted)
        if found := [path for path in _all_files(folder) if path.exists()]:
            raise StorageError(f"{found[0]}: already exists; choose another folder, or add --force to replace it")
        record = cls(folder, wanted)
        record.write()
        return record

    @classmethod
    def _read(cls, folder: Path, wanted: dict[str, Any]) -> Self:
        path = folder / SUMMARY
        again = "choose another folder, or add --force to make everything anew"
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            steps = [Step(**step) for step in content["steps"]]
            record = cls(folder, content["settings"], steps, content["planned"], content["figures"])
        except (ValueError, KeyError, TypeError) as cause:
            raise FormatError(f"{path}: was not written by `prtbake make`, or is damaged; {again}") from cause
        for name, value in wanted.items():
            if record.settings.get(name) != value:
                raise StorageError(
                    f"{folder}: was made with {name} {record.settings.get(name)!r}, found {value!r}; {again}"
                )
        return record

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
    def seconds(self) -> float:
        """Time of all finished steps."""
        return sum(step.seconds for step in self.steps)

    def write(self) -> None:
        """Write `summary.json`."""
        content = {
            "settings": self.settings,
            "seconds": round(self.seconds, 1),
            "figures": self.figures,
            "steps": [asdict(step) for step in self.steps],
            "planned": self.planned,
        }
        write_report(content, self.folder / SUMMARY)


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
