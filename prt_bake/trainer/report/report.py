"""`report_training`: measures a trained model and writes the report beside it."""

import math
import time
from pathlib import Path
from typing import Any

from bakers.transport import on_mesh
from formats.atomic import refuse_unwritable
from formats.errors import ModelError, PrtbakeError
from formats.scene import Scene
from prt_bake.network.file_names import report_paths
from prt_bake.trainer.references import Follow, silent
from prt_bake.trainer.report.assessment import ASSESSMENT_SEED, assess
from prt_bake.trainer.report.evaluation import VERTICES
from prt_bake.trainer.report.page import write_training_report
from prt_bake.trainer.report.picture import SUNS, picture_criterion, picture_error, picture_summary

QUERIES, SECONDS = 1024, 40.0
_PICTURE_SHARE = 0.5
"""Time for each picture over the time for queries."""
_QUERIES_SHARE = 0.5
"""Share of the time for queries; pictures get the rest."""
_PAGE_SECONDS, _PAGE_SHARE = 3.0, 0.25
"""Time that a report within a limit keeps for the plots and the page, and its share if that is more."""
_LEAST_PICTURE = 0.8
"""A report within a limit has no picture if there are fewer seconds for it."""


def report_training(
    network: Any,
    scene: Scene,
    model: str | Path,
    *,
    seconds: float = SECONDS,
    within: float | None = None,
    queries: int = QUERIES,
    vertices: int = VERTICES,
    seed: int = 0,
    follow: Follow = silent,
) -> tuple[dict[str, Any], Path]:
    """Assess `network` on its scene and write MODEL.report.json and MODEL.report.html beside `model`.

    Evaluates and path traces queries for `seconds`, and half as long again for each picture under a sun (`picture.py`).
    With `within` the whole report takes about that many seconds instead, and has fewer queries and no pictures if these
    are few. `follow` receives the finished share. The history of the training is
    `network.metadata["training"]["validation_vs_time"]`, rows (seconds, walks, validation error).

    Returns the report and the path of the page. Raises ModelError if the model was trained on another scene,
    StorageError, at once, if a file cannot be written, and PrtbakeError without matplotlib (the JSON is written by
    then).
    """
    begun = time.perf_counter()
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
    page_seconds = 0.0
    if within is not None:
        page_seconds = max(_PAGE_SECONDS, _PAGE_SHARE * within)
        seconds = max(0.0, _QUERIES_SHARE * (within - page_seconds))
    report = assess(
        bound,
        scene,
        queries=queries,
        seed=ASSESSMENT_SEED + seed,
        history=network.metadata.get("training", {}).get("validation_vs_time", []),
        seconds=seconds,
        vertices=vertices,
        follow=lambda share: follow(_QUERIES_SHARE * share),
    )
    end = None if within is None else begun + within - page_seconds
    _add_pictures(report, bound, scene, _PICTURE_SHARE * seconds, seed, end, follow)
    write_training_report(report, json_path, page_path)
    return report, page_path


def _add_pictures(
    report: dict[str, Any],
    network: Any,
    scene: Scene,
    seconds: float,
    seed: int,
    end: float | None,
    follow: Follow,
) -> None:
    """Add a picture under each sun: `seconds` of path tracing for each, or all of them until `end`."""
    pictures = []
    for number, sun in enumerate(SUNS):
        follow(_QUERIES_SHARE + (1.0 - _QUERIES_SHARE) * number / len(SUNS))
        left = math.inf if end is None else (end - time.perf_counter()) / (len(SUNS) - number)
        if left < _LEAST_PICTURE:
            report["summary"].append(
                "There are not all pictures: the time was too short; `prtbake report training` makes them."
            )
            break
        try:
            pictures.append(picture_error(network, scene, sun, seconds, seed, left))
        except PrtbakeError as fault:
            report["summary"].append(f"There are no pictures: {fault}.")
            break
    report["pictures"] = pictures
    report["criteria"] += [picture_criterion(picture) for picture in pictures]
    report["summary"] += [picture_summary(picture) for picture in pictures]
