"""The networks and importance modules of the scenes: copied from the repository, or trained if it has none."""

import json
import shutil
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

from formats.atomic import replacing, sha256
from formats.errors import ModelError
from formats.mesh import Mesh
from formats.scene import Scene
from prt_bake.importance.module import importance_path, load_importance, save_importance
from prt_bake.lights.lighting import Lighting
from prt_bake.network.bssrdf import PRESETS, NetworkSettings, load_model
from prt_bake.network.model import Model
from prt_bake.paper.artefacts import Artefact, Artefacts, Facts, Stopped

Progress = Callable[[float, str], None]
"""progress(share done, text)."""


def scene_model(
    artefacts: Artefacts, name: str, scene: Scene, given: Path, minutes: float, device: str, progress: Progress
) -> Artefact:
    """Return the scene's network `name`/model.pt: a copy of `given` if it was trained on this scene, else trained.

    Raises SceneError for a scene that cannot be learnt, Stopped if a stop was requested.
    """
    file = f"{name}/model.pt"
    if given.is_file():
        network = load_model(given)
        if network.metadata.get("scene_hash") == scene.content_hash:
            inputs = {"scene": scene.content_hash, "given": sha256(given)}
            return artefacts.make(file, inputs, lambda path: _copied(given, path, network))
        artefacts.say(f"{given}: was trained on another scene than {scene.path}; a new model is trained")
    return train_once(artefacts, file, scene, minutes, device, progress)


def train_once(
    artefacts: Artefacts,
    file: str,
    scene: Scene,
    minutes: float,
    device: str,
    progress: Progress,
    settings: NetworkSettings | None = None,
    *,
    baseline: str | None = None,
    light: Lighting | None = None,
    seed: int = 0,
) -> Artefact:
    """Return a model trained for `minutes`; resumes a stopped training.

    It is the network, by default with the measured preset, or the named baseline (`prt_bake.baselines.by_name`), which
    may learn from pictures under a `light`. Raises SceneError or QueryError for a scene that the model cannot learn,
    and Stopped if a stop was requested.
    """
    from prt_bake.baselines.by_name import train_baseline
    from prt_bake.trainer.samples.rows import StreamSettings
    from prt_bake.trainer.train import LearningSettings, train

    chosen = settings or replace(PRESETS["measured"], seed=seed)
    fit: Callable[..., Model] = partial(train, settings=chosen)
    inputs = {
        "scene": scene.content_hash,
        "minutes": minutes,
        "device": device,
        "settings": chosen.as_json(),
        "learning": asdict(LearningSettings()),
        "walks": asdict(StreamSettings()),
        **({"seed": seed} if seed else {}),
    }
    if baseline is not None:
        fit, device = partial(train_baseline, baseline=baseline, light=light), "cpu"
        inputs |= {"settings": {}, "device": device, "baseline": baseline}
    if light is not None:
        inputs["light"] = light.content_hash()

    def build(path: Path) -> Facts:
        started = path.with_suffix(".started.json")
        identity = json.dumps(inputs, sort_keys=True, allow_nan=False)
        same_inputs = path.is_file() and started.is_file() and started.read_text(encoding="utf-8") == identity
        with replacing(started) as part:
            part.write_text(identity, encoding="utf-8")

        def report(row: Any) -> None:
            progress(row.share, f"validation error {row.validation:.2%}, {row.walks_per_second:,.0f} paths/s")

        def stop_early(name: str, share: float) -> None:
            if artefacts.stop() and name != "learning":
                raise Stopped(f"{path}: the training was stopped; the same command starts it again")

        def run_training(resume: bool) -> Model:
            return fit(
                scene,
                minutes=minutes,
                seed=seed,
                device=device,
                output=path,
                resume=resume,
                progress=report,
                say=artefacts.say,
                stop=artefacts.stop,
                part=stop_early,
            )

        resume = same_inputs and path.with_suffix(".train.pt").is_file()
        try:
            network = run_training(resume)
        except ModelError as error:
            # Another release may have written the checkpoint.
            if not resume:
                raise
            artefacts.say(f"{error}; the training restarts")
            network = run_training(False)
        if artefacts.stop():
            raise Stopped(f"{path}: the training was stopped; the same command resumes it")
        started.unlink(missing_ok=True)
        path.with_suffix(".train.pt").unlink(missing_ok=True)
        return _facts(network, path)

    return artefacts.make(file, inputs, build)


def scene_importance(
    artefacts: Artefacts, model: Artefact, given: Path, mesh: Mesh, seconds: float, device: str, progress: Progress
) -> Artefact:
    """Return the importance module of `model`: a copy of that of `given` if it is the same model, else fitted."""
    file = str(importance_path(model.path).relative_to(artefacts.folder))
    if importance_path(given).is_file() and given.is_file() and sha256(given) == model.sha256:
        inputs = {"model": model.sha256, "given": sha256(importance_path(given))}
        return artefacts.make(file, inputs, lambda path: _importance_copied(given, model, path))
    fitted: Facts = {"model": model.sha256, "mesh": mesh.content_hash, "seconds": seconds}

    def build(path: Path) -> Facts:
        from prt_bake.importance.fit import fit_importance

        module = fit_importance(load_model(model.path), mesh, seconds=seconds, device=device, progress=progress)
        artefacts.check()
        save_importance(module, model.path)
        return {"megabytes": path.stat().st_size / 1e6, "fit": module.metadata["fit"]}

    return artefacts.make(file, fitted, build)


def _importance_copied(given: Path, model: Artefact, path: Path) -> Facts:
    shutil.copyfile(importance_path(given), path)
    module = load_importance(model.path)
    return {"megabytes": path.stat().st_size / 1e6, "fit": module.metadata.get("fit", {})}


def _copied(given: Path, path: Path, network: Model) -> Facts:
    shutil.copyfile(given, path)
    return _facts(network, path)


def _facts(network: Model, path: Path) -> Facts:
    """Return the figures of the training and the size on disk."""
    training = network.metadata.get("training", {})
    names = ("seconds", "steps", "walks", "relative_rmse", "validation_vs_time")
    return {
        "megabytes": path.stat().st_size / 1e6,
        **{name: training[name] for name in names if name in training},
    }
