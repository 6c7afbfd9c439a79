"""The training-time ablation: errors and FLIP against minutes of training, extrapolated to the target."""

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from prt_bake.paper.models import train_once
from prt_bake.paper.results import BARS, as_number
from prt_bake.paper.scene_report import SceneReport
from prt_bake.paper.tables import shown

SHARES = (0.125, 0.25, 0.5, 1.0)
"""Relative to the full training time."""

_NEVER = math.log(1e12)
"""Logarithm of two million years in minutes."""


@dataclass(frozen=True)
class Trained:
    """A training and its picture by the primary sampling.

    Attributes:
        minutes, walks: time and paths of the training.
        coefficients: relative RMSE of a_lm on held-out queries; nan if noise hides it.
        flip, flip_without_noise, error: as in `prt_bake.paper.results.Line`.
    """

    minutes: float
    walks: int
    coefficients: float
    flip: float
    flip_without_noise: float
    error: float


@dataclass(frozen=True)
class PowerLaw:
    """The power law value = level · minutes^slope."""

    level: float
    slope: float

    def minutes_to(self, value: float) -> float:
        """Return the minutes at which it reaches `value`; infinite if it does not fall or falls too slowly."""
        if not self.slope < 0.0:
            return math.inf
        power = math.log(value / self.level) / self.slope
        return math.exp(power) if power < _NEVER else math.inf


def trainings(
    scene: SceneReport, sky: str, sky_path: Path, minutes: float, progress: Callable[[str, float, str], None]
) -> list[Trained]:
    """Train for several shares of `minutes`, each from the start, and render under one sky. Raises Stopped.

    All pictures use the importance module of the scene's own network; any sampling density is unbiased.
    """
    rows = []
    for share in SHARES:
        time, name = share * minutes, scene.paper.name
        label = f"{name}: {time:g} minutes"

        def report(done: float, text: str, label: str = label) -> None:
            progress(label, done, text)

        file = f"{name}/times/{time:g}.pt"
        model = train_once(scene.artefacts, file, scene.scene, time, scene.settings.device, report)
        figures = scene.evaluate_model(sky, sky_path, model, f"{name}/times/{time:g}_{sky}")
        coefficients = as_number(model.facts["relative_rmse"]["coefficients"])
        rows.append(Trained(time, int(model.facts["walks"]), coefficients, **figures))
    return rows


def power_law(rows: Sequence[Trained], figure: str) -> PowerLaw:
    """Fit the power law of the named figure by least squares in log-log space."""
    values = np.array([getattr(row, figure) for row in rows])
    minutes = np.array([row.minutes for row in rows])
    positive = values > 0.0
    if positive.sum() < 2:
        return PowerLaw(math.nan, 0.0)
    slope, level = np.polyfit(np.log(minutes[positive]), np.log(values[positive]), 1)
    return PowerLaw(float(np.exp(level)), float(slope))


def as_json(rows: Sequence[Trained]) -> dict[str, Any]:
    """Return the trainings, the power laws, and the extrapolated minutes to the FLIP target."""
    laws = {figure: power_law(rows, figure) for figure in ("coefficients", "error", "flip_without_noise")}
    return {
        "trainings": [asdict(row) for row in rows],
        "laws": {figure: asdict(law) for figure, law in laws.items()},
        "minutes_to_the_bar": laws["flip_without_noise"].minutes_to(BARS["net"]),
    }


def summary(name: str, rows: Sequence[Trained]) -> str:
    """Return a line per training, and the extrapolation to the FLIP target."""
    law = power_law(rows, "flip_without_noise")
    lines = [
        f"{name}: {row.minutes:g} minutes, {row.walks:,} paths: a_lm {shown(row.coefficients, '.1%')}, "
        f"picture {shown(row.error, '.1%')}, "
        f"FLIP {row.flip:.4f}, without noise {row.flip_without_noise:.4f}"
        for row in rows
    ]
    minutes = law.minutes_to(BARS["net"])
    if math.isinf(minutes):
        lines.append(f"{name}: FLIP does not fall with the training time; the target cannot be extrapolated")
    else:
        lines.append(
            f"{name}: FLIP falls as minutes^{law.slope:.2f}; by extrapolation the target of {BARS['net']:g} would take "
            f"{minutes:,.0f} minutes on this machine"
        )
    return "\n".join(lines)
