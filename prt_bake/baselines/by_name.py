"""`train_baseline`: trains a baseline by its name, as `prtbake train --baseline` does."""

from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

from numpy.typing import ArrayLike

from formats.errors import QueryError, refuse_path
from formats.scene import Scene
from prt_bake.lights.lighting import Lighting
from prt_bake.network.model import Model
from prt_bake.trainer.budget import Budget
from prt_bake.trainer.run import Part, Progress

BASELINES = {
    "neumip": ("prt_bake.baselines.neumip_training", "train_neumip"),
    "neumip-pyramid": ("prt_bake.baselines.neumip_training", "train_neumip_pyramid"),
    "neumip-log": ("prt_bake.baselines.neumip_training", "train_neumip_log"),
    "nerfactor": ("prt_bake.baselines.nerfactor_training", "train_nerfactor"),
    "nerfactor-known": ("prt_bake.baselines.nerfactor_pictures", "train_known_light"),
    "nerfactor-unknown": ("prt_bake.baselines.nerfactor_pictures", "train_unknown_light"),
}
"""Name → module and function (`TrainBaseline`) that trains it."""
FROM_PICTURES = ("nerfactor-known", "nerfactor-unknown")
"""Those that learn from pictures under a light."""


class TrainBaseline(Protocol):
    """Trains a baseline; the arguments are those of `prt_bake.trainer.train.train`.

    The model is written to `output`, if that is given, and has in `metadata["training"]` at least seconds, steps,
    walks, stopped and, unless it was stopped, relative_rmse (`prt_bake.trainer.validation.final_errors`, as a dict).
    What a baseline does not support it refuses by QueryError.
    """

    def __call__(
        self,
        scene: Scene,
        *,
        minutes: float,
        steps: int | None,
        seed: int,
        device: str,
        output: str | Path | None,
        resume: bool,
        synchronous: bool,
        samples: str | Path | None,
        progress: Progress | None,
        say: Callable[[str], None] | None,
        stop: Callable[[], bool] | None,
        part: Part | None,
        budget: Budget | None,
    ) -> Model:
        """The trained model."""


def train_baseline(
    scene: Scene,
    baseline: str,
    *,
    light: ArrayLike | Lighting | None = None,
    minutes: float = 10.0,
    steps: int | None = None,
    seed: int = 0,
    device: str = "cpu",
    output: str | Path | None = None,
    resume: bool = False,
    synchronous: bool = False,
    samples: str | Path | None = None,
    progress: Progress | None = None,
    say: Callable[[str], None] | None = None,
    stop: Callable[[], bool] | None = None,
    part: Part | None = None,
    budget: Budget | None = None,
) -> Model:
    """Train a model that the paper compares itself with, from the same walks as `prt.train`.

    Args:
        scene: the scene to path trace.
        baseline: one of `BASELINES`.
        light: the light of the pictures of those `FROM_PICTURES`, a lat-long picture or a lighting; by default the
            shipped sky.
        minutes, steps, seed, output, resume, synchronous, samples, progress, say, stop, part, budget: as for
            `prt.train`.
        device: where the model learns, "cpu".

    Returns the model, which `prt.bake`, `prt.render_network` and `prt.load_model(output)` take and give as they do a
    neural BSSRDF. Raises QueryError for an unknown baseline, and what `prt.train` raises.

    >>> import prt_bake as prt
    >>> from prt_bake.baselines import train_baseline
    >>> model = train_baseline(prt.load_scene("spot.toml"), "neumip", steps=2)
    >>> model.metadata["training"]["steps"]
    2
    """
    refuse_path("scene", scene, "prt.load_scene")
    if baseline not in BASELINES:
        raise QueryError(f"baseline: expected one of {', '.join(BASELINES)}, found {baseline!r}")
    module, name = BASELINES[baseline]
    found: Any = getattr(import_module(module), name)
    if light is not None:
        if baseline not in FROM_PICTURES:
            raise QueryError(
                f"light: only {' and '.join(FROM_PICTURES)} learn under a light, {baseline} does not; omit it"
            )
        found = partial(found, sky=light)
    train: TrainBaseline = found
    return train(
        scene,
        minutes=minutes,
        steps=steps,
        seed=seed,
        device=device,
        output=output,
        resume=resume,
        synchronous=synchronous,
        samples=samples,
        progress=progress,
        say=say,
        stop=stop,
        part=part,
        budget=budget,
    )
