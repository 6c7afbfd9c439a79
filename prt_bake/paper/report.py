"""`prtbake report paper`: every scene under every sky; after each of them the tables, the sheets and the plots anew."""

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from formats.atomic import replacing
from formats.errors import StorageError
from formats.image import read_image
from formats.json_report import as_text
from prt_bake.paper import results as records
from prt_bake.paper.artefacts import Artefacts
from prt_bake.paper.layers import ablation
from prt_bake.paper.plots import plot_layers, plot_times, plot_training
from prt_bake.paper.results import METHODS, TITLES, Result
from prt_bake.paper.scene_report import Progress, SceneReport
from prt_bake.paper.scenes import SKIES, PaperScene, open_scene
from prt_bake.paper.settings import ReportSettings
from prt_bake.paper.sheet import Row, Tile, write_sheet
from prt_bake.paper.sigma import SigmaPicture, write_sigma
from prt_bake.paper.tables import markdown
from prt_bake.paper.times import Trained, trainings
from prt_bake.paper.times import as_json as times_json

Tell = Callable[[Result], None]


class PaperReport:
    """The report in a folder: what was made there, and what is made of it."""

    def __init__(
        self,
        out: Path,
        folder: Path,
        settings: ReportSettings,
        *,
        quick: bool = False,
        say: Callable[[str], None] = print,
        progress: Progress = lambda what, share, words: None,
        stop: Callable[[], bool] = lambda: False,
    ) -> None:
        """Into `out`, of the scenes that lie under `folder`; raises StorageError where `out` cannot be written to."""
        self.settings, self._folder, self._progress = settings.quick() if quick else settings, folder, progress
        self._quick = quick
        self.artefacts = Artefacts(out, say, stop)
        self.results: list[Result] = []
        self._sigma: list[SigmaPicture] = []

    def run(self, scenes: Sequence[PaperScene], skies: dict[str, Path], tell: Tell) -> None:
        """Every scene under every sky; `tell` is called after each, when the tables hold it. Raises Stopped."""
        for paper in scenes:
            scene = SceneReport(paper, self._folder, self.settings, self.artefacts, self._progress)
            self._sigma.append(scene.sigma())
            for name, path in skies.items():
                result = scene.under(name, path)
                self.results.append(result)
                self.write()
                tell(result)

    def run_layers(self, scenes: Sequence[PaperScene]) -> dict[str, dict[str, float]]:
        """MSE by number of layers for each scene, with the plot layers.png and layers.json. Raises Stopped."""
        found = {}
        for paper in scenes:
            scene = open_scene(paper, self._folder)
            minutes, device = self.settings.train_minutes, self.settings.device
            found[paper.name] = ablation(self.artefacts, paper.name, scene, minutes, device, self._progress)
            plot_layers(found, self.artefacts.folder / "layers.png")
            _write_text(self.artefacts.folder / "layers.json", as_text({"minutes": minutes, "relative_mse": found}))
        return found

    def run_times(self, scenes: Sequence[PaperScene], skies: dict[str, Path]) -> dict[str, list[Trained]]:
        """Trainings of several lengths for each scene under each sky, with times.png and times.json. Raises Stopped."""
        found: dict[str, list[Trained]] = {}
        for paper in scenes:
            scene = SceneReport(paper, self._folder, self.settings, self.artefacts, self._progress)
            for sky, path in skies.items():
                name = f"{paper.name}, {sky}"
                found[name] = trainings(scene, sky, path, self.settings.train_minutes, self._progress)
                plot_times(found, self.artefacts.folder / "times.png")
                laws = {name: times_json(rows) for name, rows in found.items()}
                _write_text(self.artefacts.folder / "times.json", as_text(laws) + "\n")
        return found

    def write(self) -> None:
        """Write tables.md, tables.json, the sheets, sigma.png and training.png from the results so far."""
        folder, settings = self.artefacts.folder, self._settings_json()
        _write_text(folder / "tables.md", markdown(self.results, settings))
        _write_text(folder / "tables.json", as_text(records.as_json(self.results, settings)) + "\n")
        columns = ("reference", *(TITLES[method] for method in METHODS))
        write_sheet(folder / "sheet.png", columns, [self._row(result, whole=False) for result in self.results])
        write_sheet(folder / "everything.png", columns, [self._row(result, whole=True) for result in self.results])
        write_sigma(folder / "sigma.png", self._sigma)
        curves = {result.scene: result.model.get("validation_vs_time", []) for result in self.results}
        plot_training(curves, folder / "training.png")

    @property
    def files(self) -> tuple[Path, ...]:
        """What was written for the reader."""
        pictures = ("sheet", "everything", "training", "sigma", "layers", "times")
        names = ("tables.md", "tables.json", *(f"{picture}.png" for picture in pictures))
        return tuple(path for path in (self.artefacts.folder / name for name in names) if path.is_file())

    def _row(self, result: Result, whole: bool) -> Row:
        """A row of the sheet: the reference, and every method's picture with its map of FLIP."""
        folder = self.artefacts.folder / result.scene / result.sky
        ours, theirs = (
            (read_image(folder / f"{name}.exr") if whole else np.float32(0.0))
            for name in ("surface", "surface_reference")
        )
        tiles: list[Tile | None] = [Tile(read_image(folder / "reference.exr") + theirs, None, "")]
        with np.load(folder / "flip.npz") as maps:
            for method in METHODS:
                line, name = result.line(method), "sh" if method == "sh" else f"net_{method}"
                figures = None if line is None else line.whole if whole else line.alone
                if figures is None:
                    tiles.append(None)
                    continue
                flip_map = maps[f"{method}_whole" if whole else method]
                words = f"FLIP {figures['flip']:.4f}"
                tiles.append(Tile(read_image(folder / f"{name}.exr") + ours, flip_map, words))
        return Row(f"{result.scene}, {result.sky}", result.stops, tuple(tiles))

    def _settings_json(self) -> dict[str, Any]:
        return {**asdict(self.settings), "quick": self._quick, "cores": os.cpu_count()}


def sky_files(asked: Sequence[str], folder: Path) -> dict[str, Path]:
    """Skies by name: "outdoor" and "indoor" of the repository (both where none is asked for), or files of one's own.

    Raises StorageError where there is no such file.
    """
    return dict(_skies(asked or tuple(SKIES), folder))


def _skies(asked: Sequence[str], folder: Path) -> Iterator[tuple[str, Path]]:
    for word in asked:
        path = folder / SKIES[word] if word in SKIES else Path(word)
        if not path.is_file():
            raise StorageError(f"{path}: there is no such sky; give {', '.join(SKIES)} or a lat-long .hdr or .exr")
        yield (word if word in SKIES else path.stem), path


def _write_text(path: Path, text: str) -> None:
    with replacing(path) as part:
        part.write_text(text, encoding="utf-8")
