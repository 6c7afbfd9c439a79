"""One scene of the report: its model and asset, then reference, pictures and figures under each sky."""

from collections.abc import Callable, Iterator
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.atomic import replacing
from formats.image import read_image, read_layers, write_image
from prt_bake.comparison import object_figures
from prt_bake.geometry.camera import Camera
from prt_bake.lights.environment import read_environment, rotation
from prt_bake.lights.lighting import Lighting, Sky
from prt_bake.paper.artefacts import Artefact, Artefacts, Facts
from prt_bake.paper.harmonics import DEGREE, bake_asset, shade_asset_picture
from prt_bake.paper.models import scene_importance, scene_model
from prt_bake.paper.network_pictures import render_network_picture
from prt_bake.paper.reference import Reference, reference, trace_scene
from prt_bake.paper.results import METHODS, PRIMARY_SAMPLING, SAMPLINGS, Line, Result
from prt_bake.paper.scenes import PaperScene, framing_camera, is_stand_in, open_scene
from prt_bake.paper.settings import ReportSettings
from prt_bake.paper.sigma import SigmaPicture, sigma_picture
from prt_bake.paper.surface import surface_picture
from prt_bake.rendering.mixture import Sampling
from prt_bake.rendering.scene import render_scene
from prt_bake.tracer.prepared import has_unscattered

Progress = Callable[[str, float, str], None]
"""progress(step, share done, text)."""

_METHOD = 2
"""Version of the results; raised when the same inputs give other pictures, which rebuilds all but references and
models.
"""
_PICTURE_SEED = 0x7AB1E5
"""Seed of the pictures that are compared with references; the references use other seeds."""
SURFACE_SPP, SURFACE_REFERENCE_SPP = 64, 256
"""Samples per pixel of reflection and background, in the pictures and in the reference."""
UNSCATTERED_SPP = 64
"""Paths per pixel of unscattered transmission, in both."""


class SceneReport:
    """The report of one scene."""

    def __init__(
        self,
        paper: PaperScene,
        folder: Path,
        settings: ReportSettings,
        artefacts: Artefacts,
        progress: Progress,
    ) -> None:
        """Read the scene from `folder` and set up its camera."""
        self.paper, self.folder, self.settings = paper, folder, settings
        self.artefacts, self._progress = artefacts, progress
        self.scene = open_scene(paper, folder)
        self.view = framing_camera(self.scene.mesh, settings.size, self.scene.up)

    @cached_property
    def model(self) -> Artefact:
        """The scene's network."""
        name, settings = self.paper.name, self.settings
        return scene_model(
            self.artefacts,
            name,
            self.scene,
            self._shipped_model,
            settings.train_minutes,
            settings.device,
            lambda share, text: self._progress(f"{name}: training", share, text),
        )

    @cached_property
    def importance(self) -> Artefact:
        """The importance module of the network."""
        name, settings = self.paper.name, self.settings
        return scene_importance(
            self.artefacts,
            self.model,
            self._shipped_model,
            self.scene.mesh,
            settings.importance_seconds,
            settings.device,
            lambda share, text: self._progress(f"{name}: fitting the importance module", share, text),
        )

    @property
    def _shipped_model(self) -> Path:
        """Path of the scene's network in the repository."""
        return self.folder / "models" / f"{self.paper.name}.pt"

    @cached_property
    def asset(self) -> Artefact:
        """The network baked at degree 2."""
        settings = self.settings.bake(self.paper.bake)
        model, name = self.model, f"{self.paper.name}/asset.h5"
        inputs = {"method": _METHOD, "model": model.sha256, "degree": DEGREE, **asdict(settings)}
        arguments = model, self.scene.mesh, settings, self.artefacts.stop, self._reporter(f"{self.paper.name}: baking")
        return self.artefacts.make(name, inputs, lambda path: bake_asset(path, *arguments))

    def under(self, sky_name: str, sky_path: Path) -> Result:
        """Measure the scene under one sky. Raises Stopped; all finished steps are kept."""
        lighting = self.lighting(sky_path)
        target = self.reference(sky_name, lighting)
        pictures = dict(self._pictures(sky_name, lighting))
        return self._result(sky_name, target, pictures, self._surfaces(sky_name, lighting))

    def evaluate_model(self, sky_name: str, sky_path: Path, model: Artefact, name: str) -> dict[str, float]:
        """Return flip, flip_without_noise and error of another network's picture, with the primary sampling.

        Writes the picture `name`.exr. Its directions are sampled by the importance module of the scene's own network.
        """
        lighting = self.lighting(sky_path)
        target = self.reference(sky_name, lighting)
        picture = read_layers(self.network_picture(lighting, PRIMARY_SAMPLING, f"{name}.exr", model).path)
        mask = object_figures.object_mask(target.coverage)
        _map, figures = object_figures.subsurface_figures(
            picture, target, mask, object_figures.exposure(target.image, mask)
        )
        return {name: figures[name] for name in ("flip", "flip_without_noise", "error")}

    def sigma(self) -> SigmaPicture:
        """Return the lobe widths of the importance module at the visible points."""
        return sigma_picture(self.paper.title, self.importance.path.with_name("model.pt"), self.scene.mesh, self.view)

    def lighting(self, path: Path) -> Lighting:
        """Return the light of a sky, upright as the scene is."""
        up = self.scene.up
        return Lighting((Sky(read_environment(path), up, rotation(0.0, up)),))

    def _view_inputs(self, lighting: Lighting) -> Facts:
        return {"light": lighting.content_hash(), "camera": camera_json(self.view)}

    def reference(self, sky: str, lighting: Lighting) -> Reference:
        """Path trace the subsurface light alone. Raises Stopped."""
        name, settings = f"{self.paper.name}/{sky}/reference.exr", self.settings
        inputs = {"scene": self.scene.content_hash, "seed": settings.seed, **self._view_inputs(lighting)}
        if has_unscattered(self.scene):
            inputs["shown"] = "scattered"
        trace = trace_scene(
            self.scene, lighting, self.view, self.artefacts.stop, self._reporter(f"{name}: path tracing")
        )
        goal = settings.reference_spp, settings.reference_minutes
        return reference(self.artefacts, name, inputs, settings.size, trace, *goal)

    def _pictures(self, sky: str, lighting: Lighting) -> Iterator[tuple[str, Artefact]]:
        """Yield (method, picture of subsurface light alone)."""
        folder = f"{self.paper.name}/{sky}"
        for sampling in SAMPLINGS:
            yield sampling, self.network_picture(lighting, sampling, f"{folder}/net_{sampling}.exr", self.model)
        inputs = {**self._picture_inputs(lighting, self.model), "asset": self.asset.sha256}
        arguments = self.asset, lighting.skies[0], self.view
        yield (
            "sh",
            self.artefacts.make(f"{folder}/sh.exr", inputs, lambda path: shade_asset_picture(path, *arguments)),
        )

    def _picture_inputs(self, lighting: Lighting, model: Artefact) -> Facts:
        return {"method": _METHOD, "model": model.sha256, **self._view_inputs(lighting)}

    def network_picture(self, lighting: Lighting, sampling: Sampling, file: str, model: Artefact) -> Artefact:
        """Render a network; its directions are sampled by the importance module of the scene's own network."""
        settings, importance = self.settings, None if sampling == "light" else self.importance
        inputs = {**self._picture_inputs(lighting, model), "spp": settings.spp, "sampling": sampling}
        inputs["seed"] = settings.seed
        if importance is not None:
            inputs["importance"] = importance.sha256

        def render(path: Path) -> Facts:
            return render_network_picture(
                path,
                model,
                None if importance is None else importance.path.with_name("model.pt"),
                self.scene.mesh,
                lighting,
                self.view,
                settings.spp,
                sampling,
                _PICTURE_SEED + settings.seed,
                settings.device,
                self.artefacts.stop,
                self._reporter(file),
            )

        return self.artefacts.make(file, inputs, render)

    def _surfaces(self, sky: str, lighting: Lighting) -> tuple[Artefact, Artefact]:
        """Render reflection, background and unscattered light independently for the pictures and the reference."""
        inputs = {"method": _METHOD, "scene": self.scene.content_hash, **self._view_inputs(lighting)}
        if has_unscattered(self.scene):
            inputs["unscattered"] = UNSCATTERED_SPP
        most = self.settings.spp

        def layer(name: str, spp: int, seed: int) -> Artefact:
            def render(path: Path) -> None:
                image = surface_picture(self.scene, lighting, self.view, spp, seed, self.artefacts.stop)
                if has_unscattered(self.scene):
                    image = image + self._unscattered(lighting, min(spp, UNSCATTERED_SPP), seed)
                write_image(path, image)

            file = f"{self.paper.name}/{sky}/{name}.exr"
            return self.artefacts.make(file, {**inputs, "spp": spp, "seed": seed}, render)

        return (
            layer("surface", min(most, SURFACE_SPP), _PICTURE_SEED + self.settings.seed),
            layer("surface_reference", min(most, SURFACE_REFERENCE_SPP), self.settings.seed),
        )

    def _unscattered(self, lighting: Lighting, spp: int, seed: int) -> NDArray[np.float32]:
        """Render the unscattered transmission [H,W,3]; raises Stopped."""
        stop = self.artefacts.stop
        picture = render_scene(
            self.scene, lighting, self.view, spp, seed, background=False, shown="unscattered", stop=stop
        )
        self.artefacts.check()
        return picture.image

    def _result(
        self, sky: str, target: Reference, pictures: dict[str, Artefact], surfaces: tuple[Artefact, Artefact]
    ) -> Result:
        """Measure every picture and write the FLIP maps."""
        inputs = {
            "method": _METHOD,
            "reference": target.artefact.sha256,
            "pictures": {method: picture.sha256 for method, picture in pictures.items()},
            "surfaces": [surface.sha256 for surface in surfaces],
        }
        maps = self.artefacts.make(
            f"{self.paper.name}/{sky}/flip.npz", inputs, lambda path: self._measure(path, target, pictures, surfaces)
        )
        facts = maps.facts
        lines = tuple(
            Line(method, **self._cost(method, pictures[method]), **facts["figures"][method]) for method in METHODS
        )
        return Result(
            self.paper.name,
            sky,
            Path(self.scene.path).name,
            is_stand_in(self.paper, self.scene),
            object_figures.framing(target.coverage),
            facts["stops"],
            target.artefact.facts,
            facts["noise"],
            lines,
            self.model.facts,
            self.asset.facts,
        )

    def _measure(
        self, path: Path, target: Reference, pictures: dict[str, Artefact], surfaces: tuple[Artefact, Artefact]
    ) -> Facts:
        mask = object_figures.object_mask(target.coverage)
        alone_stops = object_figures.exposure(target.image, mask)
        surface, surface_reference = (read_image(layer.path) for layer in surfaces)
        whole = target.image + surface_reference
        whole_stops = object_figures.exposure(whole, mask)
        maps: dict[str, NDArray[np.float16]] = {}
        figures: dict[str, Any] = {}
        for method, picture in pictures.items():
            layers = read_layers(picture.path)
            flip_map, alone = object_figures.subsurface_figures(layers, target, mask, alone_stops)
            together = object_figures.measure(layers.image + surface, whole, mask, whole_stops)
            maps[method] = flip_map.astype(np.float16)
            maps[f"{method}_whole"] = together.flip_map.astype(np.float16)
            figures[method] = {"alone": alone, "whole": together.as_json()}
        harmonics, network = (read_image(pictures[method].path) for method in ("sh", PRIMARY_SAMPLING))
        figures["sh"]["alone"]["flip_to_net"] = object_figures.measure(harmonics, network, mask, alone_stops).flip
        write_maps(path, maps)
        noise = object_figures.noise_figures(target, harmonics, mask, alone_stops)
        return {"stops": alone_stops, "whole_stops": whole_stops, "noise": noise, "figures": figures}

    def _cost(self, method: str, picture: Artefact) -> Facts:
        """Return samples per pixel, seconds, and megabytes of the files that the rendering needs."""
        facts = picture.facts
        if method == "sh":
            return {"spp": 1, "seconds": facts["seconds"], "megabytes": self.asset.path.stat().st_size / 1e6}
        megabytes = self.model.facts["megabytes"]
        if method != "light":
            megabytes += self.importance.facts["megabytes"]
        return {"spp": facts["spp"], "seconds": facts["seconds"], "megabytes": megabytes}

    def _reporter(self, step: str) -> Callable[[float], None]:
        return lambda share: self._progress(step, share, "")


def camera_json(view: Camera) -> list[Any]:
    """Return the camera's parameters as plain values."""
    return [view.eye.tolist(), view.target.tolist(), view.up.tolist(), view.fov, view.width, view.height]


def write_maps(path: Path, maps: dict[str, NDArray[np.float16]]) -> None:
    """Write maps by name as .npz, atomically."""
    with replacing(path) as part, open(part, "wb") as file:
        np.savez_compressed(file, allow_pickle=False, **maps)
