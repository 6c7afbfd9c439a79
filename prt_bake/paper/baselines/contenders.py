"""The rows of the table of baselines, and their figures."""

import math
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

from prt_bake.mathematics.noise_free import Interval
from prt_bake.paper.results import paper_scene
from prt_bake.paper.scenes import PaperSky

SCENES = ("grape", "paperweight")
"""The scenes of the paper's second table."""
FIGURES = ("mse", "ssim", "ssim_quarter", "flip")
EQUAL = "net-equal"
"""The network that learned for as many minutes as the baselines; errors are given relative to its errors."""


class Contender(NamedTuple):
    """A row of the table.

    Attributes:
        name, title: its key and its name in the table.
        baseline: the name for `train_baseline`; None for the network.
        published: the model of the paper's row.
        coarse: whether it is lit by the 16×32 pixels with which a NeRFactor relights as published. It has the model of
            the contender named by its baseline.
        own_sky: whether it learns from pictures under the sky of the compared picture, and is trained for each sky.
    """

    name: str
    title: str
    baseline: str | None
    published: str
    coarse: bool = False
    own_sky: bool = False


CONTENDERS = (
    Contender("nerfactor-unknown", "NeRFactor, unknown light", "nerfactor-unknown", "nerfactor"),
    Contender("nerfactor-512", "the same, 512 lights", "nerfactor-unknown", "nerfactor", coarse=True),
    Contender("nerfactor-known", "NeRFactor, known light", "nerfactor-known", "nerfactor"),
    Contender("nerfactor-own-sky", "NeRFactor, own sky", "nerfactor-known", "nerfactor", own_sky=True),
    Contender("nerfactor", "NeRFactor, best of class", "nerfactor", "nerfactor"),
    Contender("neumip", "NeuMIP", "neumip", "neumip"),
    Contender("neumip-pyramid", "NeuMIP, pyramid", "neumip-pyramid", "neumip"),
    Contender("neumip-log", "NeuMIP, own loss", "neumip-log", "neumip"),
    Contender(EQUAL, "Net, same minutes", None, "net"),
    Contender("net", "Net", None, "net"),
)


@dataclass(frozen=True)
class Entry:
    """A contender's picture of one scene under one sky.

    Attributes:
        contender: its name.
        figures: without the noise of both pictures, each with its 95 % interval: mse, ssim, ssim_quarter, flip,
            relative_rmse. Empty if there is no picture.
        measured: mse, ssim, ssim_quarter and flip with the noise; None for one that is unknown.
        seconds, megabytes: rendering time of the picture, and size of the model's file.
        training: seconds, walks and relative_rmse of the training.
        missing: why there is no picture, or "".
    """

    contender: str
    figures: dict[str, Interval] = field(default_factory=dict)
    measured: dict[str, float | None] = field(default_factory=dict)
    seconds: float = 0.0
    megabytes: float = 0.0
    training: dict[str, Any] = field(default_factory=dict)
    missing: str = ""


@dataclass(frozen=True)
class Comparison:
    """A scene under a sky: all entries, and what the table says about the scene.

    Attributes:
        scene, sky, source, stand_in: names, the scene's file, and whether a stand-in replaces the paper's mesh.
        pixels, stops: the pixels that are compared, and the exposure.
        reference: spp, walks, seconds.
        noise: mse, ssim, ssim_quarter and flip of two equal pictures with noise like those of the reference and of the
            primary network's picture.
        ceiling: the least error of a Lambert surface, by "transport" and "coefficients", and "behind", the share of Ŝ
            from behind the tangent plane (`prt_bake.baselines.ceiling`); None for what has no values.
        entries: by contender.
    """

    scene: str
    sky: str
    source: str
    stand_in: bool
    pixels: int
    stops: float
    reference: dict[str, Any]
    noise: dict[str, float | None]
    ceiling: dict[str, Any]
    entries: tuple[Entry, ...]

    def entry(self, name: str) -> Entry | None:
        """The entry of this contender if it has a picture."""
        return next((entry for entry in self.entries if entry.contender == name and entry.figures), None)

    def factor(self, entry: Entry, figure: str) -> float | None:
        """The entry's figure divided by that of the network that learned as long; None if one of them is unknown."""
        equal = self.entry(EQUAL)
        if equal is None or not entry.figures or not equal.figures[figure].value > 0.0:
            return None
        factor = entry.figures[figure].value / equal.figures[figure].value
        return None if math.isnan(factor) else factor

    def published(self, contender: Contender) -> PaperSky | None:
        """The paper's figures of this row."""
        return paper_scene(self.scene).published.get(contender.published, {}).get(self.sky)

    def published_factor(self, contender: Contender, figure: str) -> float | None:
        """The paper's figure of this row divided by that of its network."""
        of_row = self.published(contender)
        of_net = paper_scene(self.scene).published.get("net", {}).get(self.sky)
        if of_row is None or of_net is None:
            return None
        return float(getattr(of_row, figure) / getattr(of_net, figure))

    def as_json(self) -> dict[str, Any]:
        """Plain values, with the paper's figures."""
        published = {}
        for contender in CONTENDERS:
            row = self.published(contender)
            published[contender.name] = None if row is None else asdict(row)
        return {**asdict(self), "paper": published}
