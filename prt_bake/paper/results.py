"""What was measured of one scene under one sky: plain records that become JSON and tables."""

from dataclasses import asdict, dataclass, field
from typing import Any

from prt_bake.paper.scenes import SCENES, PaperRow, PaperScene
from prt_bake.rendering.mixture import Sampling

SAMPLINGS: tuple[Sampling, ...] = ("light", "lobe", "mis")
METHODS = (*SAMPLINGS, "sh")
PRIMARY_SAMPLING: Sampling = "mis"
"""The sampling of Net that is held against the paper's figure and the bar."""
TITLES = {"light": "Net (light)", "lobe": "Net (lobe)", "mis": "Net (mis)", "sh": "SH"}
BARS = {"net": 0.03, "sh": 0.08}
"""Mean FLIP over the five scenes that is to be reached."""
PAPER_MEANS = {
    "net": sum(scene.net.flip or 0.0 for scene in SCENES) / len(SCENES),
    "sh": sum(scene.harmonics.flip or 0.0 for scene in SCENES) / len(SCENES),
}


@dataclass(frozen=True)
class Line:
    """A picture by one method.

    Attributes:
        spp: samples a pixel. seconds: of rendering alone. megabytes: what must be kept to render it.
        alone: mse, ssim, ssim_quarter, flip, flip_without_noise (an estimate: against a reference without noise) and
            error (relative RMSE, the noise of both pictures out) of the light from under the surface alone; of SH
            flip_to_net, FLIP against the evaluate_model picture of Net.
        whole: the first four with reflection and background in both pictures; None where that was not made.
    """

    method: str
    spp: int
    seconds: float
    megabytes: float
    alone: dict[str, float]
    whole: dict[str, float] | None = None


@dataclass(frozen=True)
class Result:
    """A scene under a sky.

    Attributes:
        scene, sky: names. source: the scene file. stand_in: whether the paper's own mesh was not there.
        framing: object_share, object_pixels. stops: the exposure.
        reference: spp, seconds, walks. noise: the figures of a picture that is exact but for noise as the reference's.
        model, asset: what training and bake said of themselves.
    """

    scene: str
    sky: str
    source: str
    stand_in: bool
    framing: dict[str, Any]
    stops: float
    reference: dict[str, Any]
    noise: dict[str, float]
    lines: tuple[Line, ...]
    model: dict[str, Any] = field(default_factory=dict)
    asset: dict[str, Any] = field(default_factory=dict)

    def line(self, method: str) -> Line | None:
        """The picture by this method, where it was made."""
        return next((line for line in self.lines if line.method == method), None)

    def as_json(self) -> dict[str, Any]:
        """Plain values, the paper's own figures beside them."""
        return {**asdict(self), "paper": paper_json(paper_scene(self.scene))}

    @staticmethod
    def from_json(values: dict[str, Any]) -> "Result":
        """The reverse of `as_json`."""
        own = {name: value for name, value in values.items() if name not in ("paper", "lines")}
        return Result(**own, lines=tuple(Line(**line) for line in values["lines"]))


def paper_scene(name: str) -> PaperScene:
    """The scene of that name."""
    return next(scene for scene in SCENES if scene.name == name)


def paper_row(scene: PaperScene, method: str) -> PaperRow:
    """The paper's line for a method; it has one for Net, whatever the sampling."""
    return scene.harmonics if method == "sh" else scene.net


def paper_json(scene: PaperScene) -> dict[str, Any]:
    """What the paper reports of a scene, as plain values."""
    return {
        "path_tracing": asdict(scene.path_tracing),
        "net": asdict(scene.net),
        "sh": asdict(scene.harmonics),
        "net_by_sky": {sky: asdict(row) for sky, row in (scene.net_by_sky or {}).items()},
    }


def mean_flip(
    results: list[Result], sky: str, method: str, part: str = "alone", figure: str = "flip"
) -> tuple[float, int]:
    """Mean FLIP of a method over the scenes that have it under a sky, and how many they are (nan for none)."""
    values = []
    for result in results:
        line = result.line(method) if result.sky == sky else None
        figures = None if line is None else getattr(line, part)
        if figures is not None:
            values.append(figures[figure])
    return (sum(values) / len(values) if values else float("nan")), len(values)


def as_json(results: list[Result], settings: dict[str, Any]) -> dict[str, Any]:
    """All that was measured, with means, bars and what the paper reports."""
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
