"""Trains the baselines of a scene, renders them and measures the pictures. Each finished step is kept."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from formats.errors import MeshError, QueryError
from formats.image import read_image, read_layers
from formats.json_report import as_text, write_report
from prt_bake.baselines.ceiling import measure_ceiling
from prt_bake.baselines.coarse_light import coarse_light
from prt_bake.comparison.metrics import compare
from prt_bake.comparison.noise import PixelErrors
from prt_bake.comparison.noise_free import compare_without_noise
from prt_bake.comparison.object_figures import exposure, framing, object_mask
from prt_bake.lights.environment import rotation
from prt_bake.lights.lighting import Lighting, Sky
from prt_bake.mathematics.noise_free import Interval
from prt_bake.paper.artefacts import Artefact, Artefacts, Facts, write_text
from prt_bake.paper.baselines.contenders import CONTENDERS, FIGURES, Comparison, Contender, Entry
from prt_bake.paper.baselines.table import markdown
from prt_bake.paper.models import train_once
from prt_bake.paper.reference import Reference
from prt_bake.paper.results import PRIMARY_SAMPLING
from prt_bake.paper.scene_report import Progress, SceneReport, write_maps
from prt_bake.paper.scenes import PaperScene, is_stand_in
from prt_bake.paper.settings import ReportSettings
from prt_bake.paper.sheet import Row, Tile, write_sheet
from prt_bake.paper.tables import shown

FILES = ("baselines.md", "baselines.json", "baselines.png")
"""The table and the sheet of pictures, in the folder of the report."""
_ENLARGED = 16
"""Pixels of the rendered sky for each of the 16×32, so that the interpolation between pixels hardly blurs them."""
_METHOD = 1
"""Version of the figures; raised when the same pictures give other ones."""


class BaselineReport:
    """The comparison of the network with the baselines, in the folder of a report."""

    def __init__(
        self, artefacts: Artefacts, folder: Path, settings: ReportSettings, quick: bool, progress: Progress
    ) -> None:
        """folder: that of the scenes."""
        self.artefacts, self._folder, self._settings, self._quick = artefacts, folder, settings, quick
        self._progress = progress
        self.comparisons: list[Comparison] = []

    def run(
        self, scenes: Sequence[PaperScene], skies: dict[str, Path], on_comparison: Callable[[Comparison], None]
    ) -> None:
        """Measure every scene under every sky; table and sheet are rewritten after each. Raises Stopped."""
        for paper in scenes:
            scene = SceneReport(paper, self._folder, self._settings, self.artefacts, self._progress)
            ceiling = self._ceiling(scene)
            for sky, path in skies.items():
                self.comparisons.append(self._compare(scene, sky, scene.lighting(path), ceiling))
                self._write()
                on_comparison(self.comparisons[-1])

    @property
    def files(self) -> tuple[Path, ...]:
        """The files of the report that exist."""
        return tuple(path for name in FILES if (path := self.artefacts.folder / name).is_file())

    def _models(self, scene: SceneReport, sky: str, lighting: Lighting) -> Iterator[tuple[str, Artefact | str]]:
        """Yield each contender's model, or why it has none."""
        for contender in CONTENDERS:
            name = contender.name
            try:
                yield name, scene.model if name == "net" else self._trained(scene, contender, sky, lighting)
            except (MeshError, QueryError) as refusal:
                self.artefacts.say(f"{scene.paper.name}, {contender.title}: left out: {refusal}")
                yield name, str(refusal)

    def _trained(self, scene: SceneReport, contender: Contender, sky: str, lighting: Lighting) -> Artefact:
        name, settings = scene.paper.name, self._settings
        folder = f"{name}/{sky}" if contender.own_sky else name
        label = f"{name}: training {contender.title}"
        return train_once(
            self.artefacts,
            f"{folder}/baselines/{contender.baseline or contender.name}.pt",
            scene.scene,
            settings.train_minutes,
            settings.device,
            lambda share, text: self._progress(label, share, text),
            baseline=contender.baseline,
            light=lighting if contender.own_sky else None,
            seed=settings.seed,
        )

    def _ceiling(self, scene: SceneReport) -> Facts:
        """Measure the least error of a Lambert surface."""
        settings = self._settings
        counts = {"queries": 40, "directions": 16, "walks": 4} if self._quick else {"queries": 400, "walks": 32}
        inputs = {"scene": scene.scene.content_hash, "seed": settings.seed, **counts}

        def build(path: Path) -> Facts:
            found = measure_ceiling(scene.scene, **counts, seed=settings.seed)
            facts = {name: None if part is None else part.as_json() for name, part in found._asdict().items()}
            write_report(facts, path)
            return facts

        return self.artefacts.make(f"{scene.paper.name}/baselines/ceiling.json", inputs, build).facts

    def _compare(self, scene: SceneReport, sky: str, lighting: Lighting, ceiling: Facts) -> Comparison:
        models = dict(self._models(scene, sky, lighting))
        target = scene.reference(sky, lighting)
        folder = f"{scene.paper.name}/{sky}"
        pictures = {}
        for contender in CONTENDERS:
            model = models[contender.name]
            if isinstance(model, Artefact):
                light = _coarse(lighting, scene.scene.up) if contender.coarse else lighting
                file = f"{folder}/{_picture_name(contender.name)}"
                pictures[contender.name] = scene.network_picture(light, PRIMARY_SAMPLING, file, model)
        inputs = {
            "method": _METHOD,
            "reference": target.artefact.sha256,
            "pictures": {name: picture.sha256 for name, picture in pictures.items()},
        }
        facts = self.artefacts.make(
            f"{folder}/baselines/flip.npz", inputs, lambda path: _measure(path, target, pictures)
        ).facts
        return Comparison(
            scene=scene.paper.name,
            sky=sky,
            source=Path(scene.scene.path).name,
            stand_in=is_stand_in(scene.paper, scene.scene),
            pixels=framing(target.coverage)["object_pixels"],
            stops=facts["stops"],
            reference=target.artefact.facts,
            noise=facts["noise"],
            ceiling=ceiling,
            entries=tuple(_entry(name, model, pictures, facts) for name, model in models.items()),
        )

    def _write(self) -> None:
        folder, settings = self.artefacts.folder, {**asdict(self._settings), "quick": self._quick}
        write_text(folder / "baselines.md", markdown(self.comparisons, settings))
        report = {"settings": settings, "results": [comparison.as_json() for comparison in self.comparisons]}
        write_text(folder / "baselines.json", as_text(report) + "\n")
        columns = ("reference", *(contender.title for contender in CONTENDERS))
        write_sheet(folder / "baselines.png", columns, [self._row(comparison) for comparison in self.comparisons])

    def _row(self, comparison: Comparison) -> Row:
        """Return a row of the sheet: the reference, and each picture with its FLIP map."""
        folder = self.artefacts.folder / comparison.scene / comparison.sky
        tiles: list[Tile | None] = [Tile(read_image(folder / "reference.exr"), None, "")]
        with np.load(folder / "baselines/flip.npz") as maps:
            for contender in CONTENDERS:
                entry = comparison.entry(contender.name)
                if entry is None:
                    tiles.append(None)
                    continue
                label = f"FLIP {shown(entry.figures['flip'].value, '.3f')}"
                tiles.append(Tile(read_image(folder / _picture_name(contender.name)), maps[contender.name], label))
        return Row(f"{comparison.scene}, {comparison.sky}", comparison.stops, tuple(tiles))


def _picture_name(contender: str) -> str:
    """Return the picture's file in the folder of its scene and sky; the first table has the network's picture, too."""
    return f"net_{PRIMARY_SAMPLING}.exr" if contender == "net" else f"baselines/{contender}.exr"


def _coarse(lighting: Lighting, up: str) -> Lighting:
    """Return the light as a NeRFactor sees it."""
    return Lighting((Sky(coarse_light(lighting, up, enlarged=_ENLARGED), up, rotation(0.0, up)),))


def _measure(path: Path, target: Reference, pictures: dict[str, Artefact]) -> Facts:
    """Measure every picture and write the FLIP maps."""
    mask = object_mask(target.coverage)
    stops = exposure(target.image, mask)
    maps: dict[str, NDArray[np.float16]] = {}
    facts: Facts = {"stops": stops, "figures": {}, "measured": {}, "noise": {}}
    for name, picture in pictures.items():
        layers = read_layers(picture.path)
        errors = PixelErrors(
            layers.layers["error"].astype(np.float64),
            target.standard_error.astype(np.float64),
            np.zeros(target.image.shape),
        )
        measured = compare(layers.image, target.image, mask, stops)
        found = compare_without_noise(layers.image, target.image, errors, mask, stops)
        maps[name] = measured.flip_map.astype(np.float16)
        facts["measured"][name] = {figure: getattr(measured, figure) for figure in FIGURES}
        facts["figures"][name] = {figure: found.figures[figure].as_json() for figure in (*FIGURES, "relative_rmse")}
        facts["noise"] = found.of_noise
    write_maps(path, maps)
    return facts


def _entry(name: str, model: Artefact | str, pictures: dict[str, Artefact], facts: Facts) -> Entry:
    if isinstance(model, str):
        return Entry(name, missing=model)
    return Entry(
        name,
        {figure: Interval.from_json(values) for figure, values in facts["figures"][name].items()},
        facts["measured"][name],
        pictures[name].facts["seconds"],
        model.facts["megabytes"],
        {key: model.facts[key] for key in ("seconds", "walks", "relative_rmse") if key in model.facts},
    )
