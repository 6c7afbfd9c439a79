"""Trains a NeRFactor from pictures, as published: views under one sky, whose light is unknown or known."""

import math
from collections.abc import Callable
from functools import partial
from importlib.resources import as_file, files
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from formats.atomic import refuse_unwritable
from formats.errors import QueryError, refuse_path
from formats.scene import Scene
from prt_bake.baselines.nerfactor import NeRFactor
from prt_bake.baselines.nerfactor_settings import NeRFactorSettings
from prt_bake.baselines.nerfactor_training import lobe_share, refuse_other_device
from prt_bake.baselines.picture_fit import PictureFit, PictureSettings
from prt_bake.lights.environment import read_environment
from prt_bake.lights.lighting import Lighting
from prt_bake.network.bssrdf import save_model
from prt_bake.network.checkpoint import refuse_other_suffix
from prt_bake.trainer.budget import Budget
from prt_bake.trainer.fit import metadata_of
from prt_bake.trainer.learning.learner import LearningSettings
from prt_bake.trainer.run import Part, Progress
from prt_bake.trainer.training_data import PathTracedData, stream_for

__all__ = ["PictureSettings", "train_from_pictures"]


def train_from_pictures(
    scene: Scene,
    *,
    sky: ArrayLike | Lighting | None = None,
    light: Literal["unknown", "known"] = "unknown",
    settings: NeRFactorSettings | None = None,
    pictures: PictureSettings | None = None,
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
) -> NeRFactor:
    """Train a NeRFactor from path-traced pictures of a scene.

    Args:
        scene: the scene to path trace.
        sky: the light of the pictures, a lat-long picture [H,W,3] or a lighting; by default the shipped example's sky.
        light: "unknown", as published: its 16 × 32 pixels are fitted, too; "known": they are those of the sky.
        settings: the model; by default the published one with `seed`.
        pictures: the views and the loss.
        minutes, steps, seed, output, progress, say, stop, part, budget: as for `prt.train`; without `steps` learning
            ends after the time or the epochs.
        device: "cpu" or "auto".
        synchronous: with `steps` the result is the same in each run anyway.
        resume, samples: not supported.

    Returns the model. Pictures under an unknown light determine the albedo up to a factor; it is that of least squares,
    per channel, on one more view, under the true sky. `metadata["training"]["light"]` has the light [16][32][3].

    Raises QueryError for what is not supported, for a sky that is all black, and what `prt.render_scene` raises.

    >>> import numpy as np
    >>> import prt_bake as prt
    >>> from prt_bake.baselines.nerfactor_pictures import PictureSettings, train_from_pictures
    >>> few = PictureSettings(views=2, size=8, spp=2)
    >>> scene = prt.load_scene("spot.toml")
    >>> model = train_from_pictures(scene, sky=np.ones((16, 32, 3)), pictures=few, steps=2)
    >>> model.metadata["training"]["steps"]
    2
    """
    refuse_path("scene", scene, "prt.load_scene")
    refuse_other_device(device)
    _refuse(light, minutes, steps, resume, samples, output)
    chosen = pictures or PictureSettings()
    timed = (budget or Budget(minutes)) if steps is None else None
    tell, follow = say or (lambda sentence: None), part or (lambda name, share: None)
    data = PathTracedData(scene, stream_for("cpu"), seed, True)
    learning = LearningSettings(held_out_queries=chosen.held_out_queries, held_out_walks=chosen.held_out_walks)
    tell("path tracing the validation queries")
    validation_seconds = math.inf if timed is None else timed.validation
    reference = data.reference(learning, validation_seconds, partial(follow, "validation queries"))
    model = NeRFactor(settings or NeRFactorSettings(seed=seed), scene.mesh, 1.0, metadata_of(scene))
    tell(f"path tracing {chosen.views} pictures, and one to fix the scale of the albedo")
    fit = PictureFit(model, _shipped_sky() if sky is None else sky, light, chosen, seed)
    fit.trace(scene, timed, partial(follow, "pictures"))
    tell(f"learning; the light is {light}")
    follow("learning", 0.0)
    stopped = fit.learn(steps, timed, reference, progress, stop or (lambda: False))
    network = model.eval().rounded()
    training = network.metadata["training"] = fit.description(reference.quantity)
    if output is not None:
        save_model(network, output)  # before figures that Ctrl-C interrupts
    try:
        if not stopped:
            seconds = math.inf if timed is None else timed.figures()
            training |= data.errors(network, learning, seconds, partial(follow, "final errors"))
    except KeyboardInterrupt:
        stopped = True
    training |= {"lobe_share": lobe_share(network, scene), "stopped": stopped}
    if output is not None:
        save_model(network, output)
    return network


train_unknown_light = partial(train_from_pictures, light="unknown")
train_known_light = partial(train_from_pictures, light="known")


def _shipped_sky() -> NDArray[np.float32]:
    with as_file(files("prt_bake") / "shipped" / "sky.hdr") as path:
        return read_environment(path)


def _refuse(
    light: str, minutes: float, steps: int | None, resume: bool, samples: str | Path | None, output: str | Path | None
) -> None:
    """Raise QueryError for what a training from pictures does not support, StorageError for an unwritable output."""
    if light not in ("unknown", "known"):
        raise QueryError(f'light: expected "unknown" or "known", found {light!r}')
    if minutes <= 0 or (steps is not None and steps < 1):
        raise QueryError(f"train: minutes and steps must be positive, found {minutes:g} and {steps}")
    if resume:
        raise QueryError(
            "NeRFactor: a training from pictures cannot be resumed; start it again, with the time it needs"
        )
    if samples is not None:
        raise QueryError(f"NeRFactor: it learns from pictures, not from the samples {samples}; leave them out")
    if output is not None:
        refuse_other_suffix(output)
        refuse_unwritable(output)
