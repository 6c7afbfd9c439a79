"""`report_training`: measures a trained model and writes the report beside it."""

from pathlib import Path
from typing import Any

from bakers.transport import on_mesh
from formats.atomic import refuse_unwritable
from formats.errors import ModelError, PrtbakeError
from formats.scene import Scene
from prt_bake.network.file_names import report_paths
from prt_bake.tracer.prepared import prepare
from prt_bake.trainer.report.assessment import ASSESSMENT_SEED, assess
from prt_bake.trainer.report.evaluation import VERTICES
from prt_bake.trainer.report.page import write_training_report
from prt_bake.trainer.report.picture import SUNS, picture_criterion, picture_error, picture_summary

QUERIES, SECONDS = 1024, 40.0
_PICTURE_SHARE = 0.5
"""Time for each picture over the time for queries."""


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

    Path traces queries for `seconds`, and half as long again for each picture under a sun (`picture.py`). The history
    of the training is `network.metadata["training"]["validation_vs_time"]`, rows (seconds, walks, validation error).

    Returns the report and the path of the page. Raises ModelError if the model was trained on another scene,
    StorageError, at once, if a file cannot be written, and PrtbakeError without matplotlib (the JSON is written by
    then).
    """
    json_path, page_path = report_paths(model)
    for path in (json_path, page_path):
        refuse_unwritable(path)
    scene_hash = network.metadata.get("scene_hash")
    if scene_hash not in (None, scene.content_hash):
        raise ModelError(
            f"{model}: was trained on another scene than {scene.path} (the mesh, medium or interface differs); "
            "give the scene that it was trained on"
        )
    bound = on_mesh(network, scene.mesh)
    report = assess(
        bound,
        scene,
        prepare(scene),
        queries=queries,
        seed=ASSESSMENT_SEED + seed,
        history=network.metadata.get("training", {}).get("validation_vs_time", []),
        seconds=seconds,
        vertices=vertices,
    )
    _add_pictures(report, bound, scene, _PICTURE_SHARE * seconds, seed)
    write_training_report(report, json_path, page_path)
    return report, page_path


def _add_pictures(report: dict[str, Any], network: Any, scene: Scene, seconds: float, seed: int) -> None:
    try:
        pictures = [picture_error(network, scene, sun, seconds, seed) for sun in SUNS]
    except PrtbakeError as fault:
        report["summary"].append(f"There are no pictures: {fault}.")
        return
    report["pictures"] = pictures
    report["criteria"] += [picture_criterion(picture) for picture in pictures]
    report["summary"] += [picture_summary(picture) for picture in pictures]
