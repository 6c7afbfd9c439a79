"""The figures of one scene under one sky, as records that are written as JSON and tables."""

import math
from dataclasses import asdict, dataclass, field
from typing import Any

from prt_bake.paper.scenes import SCENES, PaperRow, PaperScene
from prt_bake.rendering.mixture import Sampling

SAMPLINGS: tuple[Sampling, ...] = ("light", "lobe", "mis")
METHODS = (*SAMPLINGS, "sh")
PRIMARY_SAMPLING: Sampling = "mis"
"""The sampling of Net that is compared with the paper's figure and the target."""
TITLES = {"light": "Net (light)", "lobe": "Net (lobe)", "mis": "Net (mis)", "sh": "SH"}
BARS = {"net": 0.03, "sh": 0.08}
"""Targets of the mean FLIP over the five scenes."""
PAPER_MEANS = {
    "net": sum(scene.net.flip or 0.0 for scene in SCENES) / len(SCENES),
    "sh": sum(scene.harmonics.flip or 0.0 for scene in SCENES) / len(SCENES),
}


@dataclass(frozen=True)
class Line:
    """A picture by one method.

    Attributes:
        method: a sampling of Net, or "sh".
        spp: samples per pixel.
        seconds: rendering time.
        megabytes: size of the files that the rendering needs.
        alone: figures of subsurface light alone: mse, ssim, ssim_quarter, flip, flip_without_noise (estimated against
            a noise-free reference) and error (relative RMSE without the noise of both pictures). SH also has
            flip_to_net, its FLIP against Net with the primary sampling. None for a figure that is unknown.
        whole: the first four figures with reflection and background in both pictures, if measured.
    """

    method: str
    spp: int
    seconds: float
    megabytes: float
    alone: dict[str, float | None]
    whole: dict[str, float | None] | None = None


@dataclass(frozen=True)
class Result:
    """A scene under a sky.

    Attributes:
        scene, sky: names.
        source: name of the scene file.
        stand_in: whether a stand-in replaces the paper's mesh.
        framing: object_share, object_pixels.
        stops: the exposure.
        reference: spp, seconds, walks.
        noise: figures of an exact picture with the reference's noise; None for one that is unknown.
        lines: the pictures by method.
        model, asset: figures of the training and of the bake.
    """

    scene: str
    sky: str
    source: str
    stand_in: bool
    framing: dict[str, Any]
    stops: float
    reference: dict[str, Any]
    noise: dict[str, float | None]
    lines: tuple[Line, ...]
    model: dict[str, Any] = field(default_factory=dict)
    asset: dict[str, Any] = field(default_factory=dict)

    def line(self, method: str) -> Line | None:
        """Return the picture by this method, or None."""
        return next((line for line in self.lines if line.method == method), None)

    def as_json(self) -> dict[str, Any]:
        """Return plain values, with the paper's figures."""
        return {**asdict(self), "paper": paper_json(paper_scene(self.scene))}

    @staticmethod
    def from_json(values: dict[str, Any]) -> "Result":
        """Read what `as_json` returns."""
        own = {name: value for name, value in values.items() if name not in ("paper", "lines")}
        return Result(**own, lines=tuple(Line(**line) for line in values["lines"]))


def paper_scene(name: str) -> PaperScene:
    """Return the scene with this name."""
    return next(scene for scene in SCENES if scene.name == name)


def paper_row(scene: PaperScene, method: str) -> PaperRow:
    """Return the paper's row of a method; every sampling of Net has the same one."""
    return scene.harmonics if method == "sh" else scene.net


def paper_json(scene: PaperScene) -> dict[str, Any]:
    """Return the paper's figures of a scene as plain values."""
    return {
        "path_tracing": asdict(scene.path_tracing),
        "net": asdict(scene.net),
        "sh": asdict(scene.harmonics),
        "by_sky": {model: {sky: asdict(row) for sky, row in skies.items()} for model, skies in scene.published.items()},
    }


def mean_flip(
    results: list[Result], sky: str, method: str, part: str = "alone", figure: str = "flip"
) -> tuple[float, int]:
    """Return the mean of a figure over the scenes with this sky and method, and their number.

    The mean is nan for no scene, and if the figure of one is unknown.
    """
    values = []
    for result in results:
        line = result.line(method) if result.sky == sky else None
        figures = None if line is None else getattr(line, part)
        if figures is not None:
            values.append(as_number(figures[figure]))
    return (sum(values) / len(values) if values else math.nan), len(values)


def as_number(figure: float | None) -> float:
    """Return a figure of a record, nan if it is unknown."""
    return math.nan if figure is None else float(figure)


def as_json(results: list[Result], settings: dict[str, Any]) -> dict[str, Any]:
    """Return all results with means, targets and the paper's figures."""
    skies = list(dict.fromkeys(result.sky for result in results))
    means = {
        sky: {
            method: {
                "flip": mean_flip(results, sky, method)[0],
                "flip_without_noise": mean_flip(results, sky, method, figure="flip_without_noise")[0],
                "flip_everything_in": mean_flip(results, sky, method, "whole")[0],
                "scenes": mean_flip(results, sky, method)[1],
            }
            for method in METHODS
        }
        for sky in skies
    }
    return {
        "settings": settings,
        "mean_flip": means,
        "bars": BARS,
        "paper_mean_flip": PAPER_MEANS,
        "results": [result.as_json() for result in results],
    }
