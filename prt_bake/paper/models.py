"""The networks and importance modules of the scenes: those of the repository, or made where there are none."""

import json
import shutil
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from formats.atomic import replacing, sha256
from formats.errors import ModelError
from formats.mesh import Mesh
from formats.scene import Scene
from prt_bake.importance.module import importance_path, load_importance, save_importance
from prt_bake.network.bssrdf import PRESETS, NetworkSettings, NeuralBSSRDF, load_model
from prt_bake.paper.artefacts import Artefact, Artefacts, Facts, Stopped

Progress = Callable[[float, str], None]
"""progress(share done, a few words)."""


def scene_model(
    artefacts: Artefacts, name: str, scene: Scene, given: Path, minutes: float, device: str, progress: Progress
) -> Artefact:
    """The scene's network in `name`/model.pt: copied from `given` where that is there and of this scene, else trained.

    Raises SceneError for a scene that cannot be learnt, Stopped where the training was stopped.
    """
    file = f"{name}/model.pt"
    if given.is_file():
        network = load_model(given)
        if network.metadata.get("scene_hash") == scene.content_hash:
            inputs = {"scene": scene.content_hash, "given": sha256(given)}
            return artefacts.make(file, inputs, lambda path: _copied(given, path, network))
        artefacts.say(f"{given}: was trained on another scene than {scene.path}; it is not taken")
    return train_once(artefacts, file, scene, minutes, device, progress)


def train_once(
    artefacts: Artefacts,
    file: str,
    scene: Scene,
    minutes: float,
    device: str,
    progress: Progress,
    settings: NetworkSettings | None = None,
) -> Artefact:
    """A network trained for `minutes`, with `settings` or the usual ones; goes on where an earlier run was stopped."""
    from prt_bake.trainer.samples.rows import StreamSettings
    from prt_bake.trainer.train import LearningSettings, train

    usual = {"learning": asdict(LearningSettings()), "walks": asdict(StreamSettings())}
    chosen = (settings or PRESETS["measured"]).as_json()
    inputs = {"scene": scene.content_hash, "minutes": minutes, "device": device, "settings": chosen, **usual}

    def build(path: Path) -> Facts:
        started = path.with_suffix(".started.json")
        wanted = json.dumps(inputs, sort_keys=True)
        resume = path.is_file() and started.is_file() and started.read_text(encoding="utf-8") == wanted
        with replacing(started) as part:
            part.write_text(wanted, encoding="utf-8")

        def follow(row: Any) -> None:
            progress(row.share, f"validation error {row.validation:.2%}, {row.walks_per_second:,.0f} walks/s")
            if artefacts.stop():
                raise KeyboardInterrupt

        def learnt(going_on: bool) -> NeuralBSSRDF:
            return train(
                scene,
                minutes=minutes,
                settings=settings,
                device=device,
                output=path,
                resume=going_on,
                progress=follow,
                say=artefacts.say,
            )

        going_on = resume and path.with_suffix(".train.pt").is_file()
        try:
            network = learnt(going_on)
        except ModelError as fault:
            # What another release began cannot be gone on with.
            if not going_on:
                raise
            artefacts.say(f"{fault}; it is trained anew")
            network = learnt(False)
        if artefacts.stop():
            raise Stopped(f"{path}: the training was stopped; the same command goes on from there")
        started.unlink(missing_ok=True)
        path.with_suffix(".train.pt").unlink(missing_ok=True)
        return _facts(network, path)

    return artefacts.make(file, inputs, build)


def scene_importance(
    artefacts: Artefacts, model: Artefact, given: Path, mesh: Mesh, seconds: float, device: str, progress: Progress
) -> Artefact:
    """The importance module beside `model`: copied from beside `given` where it is there and of that model, else
    fitted.
    """
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


def _copied(given: Path, path: Path, network: NeuralBSSRDF) -> Facts:
    shutil.copyfile(given, path)
    return _facts(network, path)


def _facts(network: NeuralBSSRDF, path: Path) -> Facts:
    """What the training said of itself, and the size on disk."""
    training = network.metadata.get("training", {})
    names = ("seconds", "steps", "walks", "relative_rmse", "validation_vs_time")
    return {
        "megabytes": path.stat().st_size / 1e6,
        **{name: training[name] for name in names if name in training},
    }
