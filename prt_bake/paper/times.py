"""Where longer training leads: the pictures' error and FLIP against minutes of training, and on to the bars."""

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from prt_bake.paper.models import train_once
from prt_bake.paper.results import BARS
from prt_bake.paper.scene_report import SceneReport

SHARES = (0.125, 0.25, 0.5, 1.0)
"""Of the usual time of training."""

_NEVER = math.log(1e12)
"""In minutes: two million years."""


@dataclass(frozen=True)
class Trained:
    """A training of so many minutes and walks, and its picture by the evaluate_model sampling.

    coefficients: relative RMSE of a_lm on held-out queries, as the training ended. flip, flip_without_noise, error: as
    in `prt_bake.paper.results.Line`.
    """

    minutes: float
    walks: int
    coefficients: float
    flip: float
    flip_without_noise: float
    error: float


@dataclass(frozen=True)
class PowerLaw:
    """The power law value = level · minutes^slope through a few trainings."""

    level: float
    slope: float

    def minutes_to(self, value: float) -> float:
        """When it comes to `value`; infinite where it hardly falls, or not at all."""
        if not self.slope < 0.0:
            return math.inf
        power = math.log(value / self.level) / self.slope
        return math.exp(power) if power < _NEVER else math.inf


def trainings(
    scene: SceneReport, sky: str, sky_path: Path, minutes: float, progress: Callable[[str, float, str], None]
) -> list[Trained]:
    """Trainings of shares of `minutes`, each from the beginning, and their pictures under one sky. Raises Stopped.

    All are drawn by the one importance module of the scene's own network: any density will do.
    """
    found = []
    for share in SHARES:
        time, name = share * minutes, scene.paper.name
        label = f"{name}: {time:g} minutes"

        def follow(done: float, words: str, label: str = label) -> None:
            progress(label, done, words)

        file = f"{name}/times/{time:g}.pt"
        model = train_once(scene.artefacts, file, scene.scene, time, scene.settings.device, follow)
        figures = scene.evaluate_model(sky, sky_path, model, f"{name}/times/{time:g}_{sky}")
        coefficients = float(model.facts["relative_rmse"]["coefficients"])
        found.append(Trained(time, int(model.facts["walks"]), coefficients, **figures))
    return found


def power_law(rows: Sequence[Trained], figure: str) -> PowerLaw:
    """The law of a figure by its name: least squares of its logarithm over that of the minutes."""
    values = np.array([getattr(row, figure) for row in rows])
    minutes = np.array([row.minutes for row in rows])
    known = values > 0.0
    if known.sum() < 2:
        return PowerLaw(math.nan, 0.0)
    slope, level = np.polyfit(np.log(minutes[known]), np.log(values[known]), 1)
    return PowerLaw(float(np.exp(level)), float(slope))


def as_json(rows: Sequence[Trained]) -> dict[str, Any]:
    """The trainings, the laws through them, and when FLIP would come to the bar if it went on like that."""
    laws = {figure: power_law(rows, figure) for figure in ("coefficients", "error", "flip_without_noise")}
    return {
        "trainings": [asdict(row) for row in rows],
        "laws": {figure: asdict(law) for figure, law in laws.items()},
        "minutes_to_the_bar": laws["flip_without_noise"].minutes_to(BARS["net"]),
    }


def summary(name: str, rows: Sequence[Trained]) -> str:
    """A line a training, and where they lead."""
    law = power_law(rows, "flip_without_noise")
    lines = [
        f"{name}: {row.minutes:g} minutes, {row.walks:,} walks: a_lm {row.coefficients:.1%}, picture {row.error:.1%}, "
        f"FLIP {row.flip:.4f}, noise out {row.flip_without_noise:.4f}"
        for row in rows
    ]
    reached = law.minutes_to(BARS["net"])
    if math.isinf(reached):
        lines.append(f"{name}: FLIP does not fall with the minutes: what it would take to the bar is not to be seen")
    else:
        lines.append(
            f"{name}: FLIP falls as minutes^{law.slope:.2f}; if it went on so, the bar of {BARS['net']:g} would take "
            f"{reached:,.0f} minutes on this machine"
        )
    return "\n".join(lines)
