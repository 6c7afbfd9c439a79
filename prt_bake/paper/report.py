"""`prtbake report paper`: every scene under every sky. Tables, sheets and plots are rewritten after each."""

import os
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from formats.errors import QueryError, StorageError
from formats.image import read_image
from formats.json_report import as_text
from prt_bake.paper import results as records
from prt_bake.paper.artefacts import Artefacts, write_text
from prt_bake.paper.baselines.contenders import Comparison
from prt_bake.paper.baselines.report import FILES as BASELINE_FILES
from prt_bake.paper.baselines.report import BaselineReport
from prt_bake.paper.layers import ablation, refuse_without_values
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

OnResult = Callable[[Result], None]
_PICTURES = ("sheet.png", "everything.png", "training.png", "sigma.png", "layers.png", "times.png")
FILES = ("tables.md", "tables.json", *_PICTURES, "layers.json", "times.json", *BASELINE_FILES)
"""The names of the tables and pictures of the report; each scene also has a folder."""
_HIDDEN = ("layers.json", "times.json", "baselines.json")


class PaperReport:
    """The report in a folder."""

    def __init__(
        self,
        out: Path,
        folder: Path,
        settings: ReportSettings,
        *,
        quick: bool = False,
        say: Callable[[str], None] = print,
        progress: Progress = lambda what, share, text: None,
        stop: Callable[[], bool] = lambda: False,
    ) -> None:
        """out: the folder to write. folder: that of the scenes. Raises StorageError if `out` cannot be created."""
        self.settings, self._folder, self._progress = settings.quick() if quick else settings, folder, progress
        self._quick = quick
        self.artefacts = Artefacts(out, say, stop)
        self.results: list[Result] = []
        self._sigma: list[SigmaPicture] = []

    def run(self, scenes: Sequence[PaperScene], skies: dict[str, Path], on_result: OnResult) -> None:
        """Measure every scene under every sky; `on_result` is called after the tables hold a result. Raises Stopped."""
        for paper in scenes:
            scene = SceneReport(paper, self._folder, self.settings, self.artefacts, self._progress)
            self._sigma.append(scene.sigma())
            for name, path in skies.items():
                result = scene.under(name, path)
                self.results.append(result)
                self.write()
                on_result(result)

    def run_layers(self, scenes: Sequence[PaperScene]) -> dict[str, dict[str, float]]:
        """Run the depth ablation of each scene; writes layers.png and layers.json.

        Raises Stopped, and QueryError for a scene in which Ŝ has no values.
        """
        errors, opened = {}, {paper.name: open_scene(paper, self._folder) for paper in scenes}
        for scene in opened.values():
            refuse_without_values(scene)
        for name, scene in opened.items():
            minutes, device = self.settings.train_minutes, self.settings.device
            errors[name] = ablation(self.artefacts, name, scene, minutes, device, self._progress)
            plot_layers(errors, self.artefacts.folder / "layers.png")
            write_text(self.artefacts.folder / "layers.json", as_text({"minutes": minutes, "relative_mse": errors}))
        return errors

    def run_baselines(
        self, scenes: Sequence[PaperScene], skies: dict[str, Path], on_comparison: Callable[[Comparison], None]
    ) -> None:
        """Compare the network with the baselines; writes baselines.md, baselines.json and baselines.png.

        Raises Stopped.
        """
        report = BaselineReport(self.artefacts, self._folder, self.settings, self._quick, self._progress)
        report.run(scenes, skies, on_comparison)

    def run_times(self, scenes: Sequence[PaperScene], skies: dict[str, Path]) -> dict[str, list[Trained]]:
        """Run the training-time ablation of each scene and sky; writes times.png and times.json. Raises Stopped."""
        rows: dict[str, list[Trained]] = {}
        for paper in scenes:
            scene = SceneReport(paper, self._folder, self.settings, self.artefacts, self._progress)
            for sky, path in skies.items():
                name = f"{paper.name}, {sky}"
                rows[name] = trainings(scene, sky, path, self.settings.train_minutes, self._progress)
                plot_times(rows, self.artefacts.folder / "times.png")
                laws = {name: times_json(trained) for name, trained in rows.items()}
                write_text(self.artefacts.folder / "times.json", as_text(laws) + "\n")
        return rows

    def write(self) -> None:
        """Write tables.md, tables.json, the sheets, sigma.png and training.png from the results so far."""
        folder, settings = self.artefacts.folder, self._settings_json()
        write_text(folder / "tables.md", markdown(self.results, settings))
        write_text(folder / "tables.json", as_text(records.as_json(self.results, settings)) + "\n")
        columns = ("reference", *(TITLES[method] for method in METHODS))
        write_sheet(folder / "sheet.png", columns, [self._row(result, complete=False) for result in self.results])
        write_sheet(folder / "everything.png", columns, [self._row(result, complete=True) for result in self.results])
        write_sigma(folder / "sigma.png", self._sigma)
        curves = {result.scene: result.model.get("validation_vs_time", []) for result in self.results}
        plot_training(curves, folder / "training.png")

    @property
    def files(self) -> tuple[Path, ...]:
        """The tables and pictures of the report that exist."""
        shown = (self.artefacts.folder / name for name in FILES if name not in _HIDDEN)
        return tuple(path for path in shown if path.is_file())

    def _row(self, result: Result, complete: bool) -> Row:
        """Return a row of the sheet: the reference, and every method's picture with its FLIP map."""
        folder = self.artefacts.folder / result.scene / result.sky
        surface, surface_reference = (
            (read_image(folder / f"{name}.exr") if complete else np.float32(0.0))
            for name in ("surface", "surface_reference")
        )
        tiles: list[Tile | None] = [Tile(read_image(folder / "reference.exr") + surface_reference, None, "")]
        with np.load(folder / "flip.npz") as maps:
            for method in METHODS:
                line, name = result.line(method), "sh" if method == "sh" else f"net_{method}"
                figures = None if line is None else line.whole if complete else line.alone
                if figures is None:
                    tiles.append(None)
                    continue
                flip_map = maps[f"{method}_whole" if complete else method]
                label = f"FLIP {figures['flip']:.4f}"
                tiles.append(Tile(read_image(folder / f"{name}.exr") + surface, flip_map, label))
        return Row(f"{result.scene}, {result.sky}", result.stops, tuple(tiles))

    def _settings_json(self) -> dict[str, Any]:
        return {**asdict(self.settings), "quick": self._quick, "cores": os.cpu_count()}


def sky_files(names: Sequence[str], folder: Path) -> dict[str, Path]:
    """Return skies by name. A name is "outdoor" or "indoor" (by default both), or the path of another sky.

    Raises StorageError if there is no such file, QueryError for two skies of one name.
    """
    skies: dict[str, Path] = {}
    for name in names or tuple(SKIES):
        path = folder / SKIES[name] if name in SKIES else Path(name)
        if not path.is_file():
            expected = (
                "expected the skies of the paper's scenes there: give their folder by --scenes, or another --sky"
                if name in SKIES
                else f"expected {', '.join(SKIES)} or a lat-long .hdr or .exr"
            )
            raise StorageError(f"{path}: there is no such sky; {expected}")
        title = name if name in SKIES else path.stem
        if title in skies:
            raise QueryError(f"--sky: expected skies of different names, found two of {title}; rename one, or omit it")
        skies[title] = path
    return skies
