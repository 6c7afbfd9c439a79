"""Renders the pictures of a test set into a folder; finished pictures are kept, and a stopped run continues.

A picture is finished when its .exr exists, which appears whole and after its .png. Each has a seed of its own, so that
a continued run gives the same files as an uninterrupted one.
"""

import math
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from formats.atomic import create_folder, remove_parts
from formats.image import read_layers, write_image
from formats.scene import Scene
from prt_bake.olat import description
from prt_bake.olat.pictures import SETS, SKIES, Coordinates, Picture, held_out_skies, pictures
from prt_bake.olat.settings import OlatSettings
from prt_bake.olat.transforms import write_transforms
from prt_bake.rendering.loop import Rendering
from prt_bake.rendering.scene import render_scene
from prt_bake.rendering.state import relative_noise

_PILOT_MINUTES = 1.5 / 60.0
_PILOTS_UNDER_LIGHTS = 3


@dataclass(frozen=True)
class Cost:
    """Prediction for a test set.

    Attributes:
        pictures, finished: numbers.
        bytes: of all pictures and skies.
        seconds: for the pictures that are not finished.
        noise: relative standard error of a picture under a directional light, the mean of the pilots; NaN if all these
            pictures are finished.
    """

    pictures: int
    finished: int
    bytes: int
    seconds: float
    noise: float


class OlatSet:
    """A test set in a folder."""

    def __init__(self, scene: Scene, folder: Path, settings: OlatSettings, skies: list[Path]) -> None:
        """Place cameras and lights, and read the skies. Raises as `claim` and `held_out_skies`."""
        self.scene, self.folder, self.settings = scene, folder, settings
        self._skies = held_out_skies(skies, scene.up)
        self.pictures = list(pictures(scene, settings, self._skies))
        self.coordinates = Coordinates.of(scene.mesh, scene.up)
        self._identity = description.identity(scene, settings, self.pictures)
        description.claim(folder, self._identity)

    @property
    def missing(self) -> list[Picture]:
        """The pictures that are not finished."""
        return [picture for picture in self.pictures if not self._exr(picture).exists()]

    def predict(self) -> Cost:
        """Size and time, from pilots: pictures of the full size with few paths per pixel."""
        missing = self.missing
        seconds, size, noise = 0.0, float(self._bytes_of_skies()), math.nan
        for under_sky in (False, True):
            alike = [picture for picture in self.pictures if (picture.set == SKIES) == under_sky]
            left = sum((picture.set == SKIES) == under_sky for picture in missing)
            if not left:
                size += sum(path.stat().st_size for picture in alike for path in self._files(picture) if path.exists())
                continue
            steps = np.linspace(0, len(alike) - 1, 1 if under_sky else _PILOTS_UNDER_LIGHTS).round().astype(int)
            pilots = [self._pilot(alike[index]) for index in sorted(set(steps.tolist()))]
            of_one = np.mean(pilots, axis=0)
            seconds += left * float(of_one[0])
            size += len(alike) * float(of_one[1])
            noise = noise if under_sky else float(of_one[2])
        return Cost(len(self.pictures), len(self.pictures) - len(missing), round(size), seconds, noise)

    def write(self, stop: Callable[[], bool], progress: Callable[[float, str], None]) -> int:
        """Render the missing pictures and describe those that are finished; returns the number of finished ones.

        When `stop` returns True, the picture at work is dropped.
        """
        for name in SETS:
            create_folder(self.folder / name)
            remove_parts(self.folder / name)
        self._describe([], complete=False)
        for name, lighting in self._skies.items():
            write_image(self.folder / name, lighting.skies[0].image)
        missing = self.missing
        done = before = len(self.pictures) - len(missing)
        for picture in missing:

            def show(share: float, done: int = done) -> None:
                text = f"{done:,} of {len(self.pictures):,} pictures"
                progress((done - before + share) / len(missing), text)

            found = self._render(picture, stop=stop, progress=show)
            if not found.complete:
                break
            self._write(self.folder, picture, found)
            done += 1
        finished = [picture for picture in self.pictures if self._exr(picture).exists()]
        write_transforms(self.folder, finished, self.coordinates, self.settings)
        self._describe(finished, complete=len(finished) == len(self.pictures))
        return len(finished)

    def _bytes_of_skies(self) -> int:
        with tempfile.TemporaryDirectory() as folder:
            for number, lighting in enumerate(self._skies.values()):
                write_image(Path(folder) / f"{number}.exr", lighting.skies[0].image)
            return _bytes_in(Path(folder))

    def _render(self, picture: Picture, **options: Any) -> Rendering:
        return render_scene(
            self.scene,
            picture.lighting,
            picture.camera,
            self.settings.spp,
            picture.seed,
            background=False,
            reflection=not self.settings.subsurface,
            shown="scattered" if self.settings.subsurface else "all",
            **options,
        )

    def _pilot(self, picture: Picture) -> tuple[float, float, float]:
        """Predicted seconds, bytes and relative noise of a picture."""
        self._render(picture, minutes=0.0)  # compiles kernels
        start = time.perf_counter()
        found = self._render(picture, minutes=_PILOT_MINUTES)
        with tempfile.TemporaryDirectory() as folder:
            (Path(folder) / picture.set).mkdir()
            self._write(Path(folder), picture, _without_gaps(found))
            size = _bytes_in(Path(folder))
        beside = time.perf_counter() - start - found.seconds
        more = self.settings.spp / found.spp
        return beside + found.seconds * more, float(size), found.relative_noise / math.sqrt(more)

    def _write(self, folder: Path, picture: Picture, found: Rendering) -> None:
        texts = {
            "prtbake.scene": self.scene.content_hash,
            "prtbake.seed": str(picture.seed),
            "prtbake.spp": str(found.spp),
            "prtbake.passes": str(found.passes),
            "prtbake.shows": found.shows,
        }
        png, exr = (folder / f"{picture.name}{suffix}" for suffix in (".png", ".exr"))
        write_image(png, found.image, alpha=found.coverage)
        layers = {"error": found.standard_error}
        write_image(exr, found.image, alpha=found.coverage, layers=layers, attributes=texts)

    def _describe(self, finished: list[Picture], complete: bool) -> None:
        noise, shows = {}, ""
        for picture in finished:
            read = read_layers(self._exr(picture))
            shows = read.attributes["prtbake.shows"]
            seen = relative_noise(read.image, read.layers["error"], read.layers["A"])
            noise[picture.name] = {"seed": picture.seed, "relative_noise": seen}
        shown = {"complete": complete, "shows": shows, "pictures": noise}
        description.write_dataset(self.folder, self.scene, self.settings, self.coordinates, shown, self._identity)

    def _exr(self, picture: Picture) -> Path:
        return self.folder / f"{picture.name}.exr"

    def _files(self, picture: Picture) -> list[Path]:
        return [self.folder / f"{picture.name}{suffix}" for suffix in (".exr", ".png")]


def _without_gaps(found: Rendering) -> Rendering:
    """A picture in which the object has no exact zeros: these compress well, and more paths leave none."""
    numbers = np.random.default_rng(0).random(found.image.shape).astype(np.float32)
    gaps = (found.coverage > 0.0)[..., None] & (found.image == 0.0)
    image, error = (np.where(gaps, numbers, part) for part in (found.image, found.standard_error))
    return replace(found, image=image, standard_error=error)


def _bytes_in(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
