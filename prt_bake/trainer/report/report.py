"""`report_training`: measure a trained model and write the report beside it."""

from pathlib import Path
from typing import Any

from bakers.transport import on_mesh
from formats.errors import ModelError, PrtbakeError
from formats.scene import Scene
from prt_bake.tracer.prepared import prepare
from prt_bake.trainer.report.assessment import ASSESSMENT_SEED, assess
from prt_bake.trainer.report.evaluation import VERTICES
from prt_bake.trainer.report.page import report_paths, write_training_report
from prt_bake.trainer.report.picture import SUNS, picture_error, sentence, verdict

QUERIES, SECONDS = 1024, 40.0
_FOR_A_PICTURE = 0.5
"""Of the time for queries, as much again."""


def report_training(
    network: Any,
    scene: Scene,
    model: str | Path,
    *,
    seconds: float = SECONDS,
    queries: int = QUERIES,
    vertices: int = VERTICES,
    seed: int = 0,
) -> tuple[dict[str, Any], Path]:
    """Assess `network` on its scene and write MODEL.report.json and MODEL.report.html beside `model`.

    Path traces for `seconds`, and half as long again for each picture under a sun (`training_picture`).

    Returns the figures and where the page lies. `network.metadata["training"]["validation_vs_time"]` gives the history,
    rows of (seconds, walks, validation error). Raises ModelError where the model says that it was trained on another
    scene, StorageError if a file cannot be written, PrtbakeError (the JSON is written by then) without matplotlib.
    """
    hashed = network.metadata.get("scene_hash")
    if hashed not in (None, scene.content_hash):
        raise ModelError(
            f"{model}: was trained on another scene than {scene.path} (its mesh, medium or interface is not the same); "
            "give the scene that it was trained on"
        )
    bound = on_mesh(network, scene.mesh)
    found = assess(
        bound,
        scene,
        prepare(scene),
        queries=queries,
        seed=ASSESSMENT_SEED + seed,
        history=network.metadata.get("training", {}).get("validation_vs_time", []),
        seconds=seconds,
        vertices=vertices,
    ).as_json()
    _add_pictures(found, bound, scene, _FOR_A_PICTURE * seconds, seed)
    json_path, page_path = report_paths(model)
    write_training_report(found, json_path, page_path)
    return found, page_path


def _add_pictures(found: dict[str, Any], network: Any, scene: Scene, seconds: float, seed: int) -> None:
    try:
        pictures = [picture_error(network, scene, sun, seconds, seed) for sun in SUNS]
    except PrtbakeError as fault:
        found["summary"].append(f"There are no pictures: {fault}.")
        return
    found["pictures"] = pictures
    found["criteria"] += [verdict(picture) for picture in pictures]
    found["summary"] += [sentence(picture) for picture in pictures]
