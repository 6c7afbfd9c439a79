"""The page of `prtbake export` in Chromium: folders that it shows, and what it then says and computes."""

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from prt_bake.export.site import PAGE
from prt_bake.geometry.camera import Camera
from tests.engines.conftest import RunNode

Step = list[Any]
BACKENDS: dict[str, dict[str, Any]] = {"webgl": {"query": "backend=webgl"}, "webgpu": {"webgpu": True}}


def make_site(folder: Path, assets: Sequence[Path], lights: Sequence[Path] = ()) -> Path:
    """Write a folder as the export of a site does, of files as they are."""
    shutil.copytree(PAGE, folder, ignore=shutil.ignore_patterns("node_modules", "*.json", "*.mjs"))
    for path in (*assets, *lights):
        shutil.copyfile(path, folder / path.name)
    described = {
        name: [{"name": path.stem if name == "objects" else path.name, "file": path.name} for path in paths]
        for name, paths in (("objects", assets), ("lights", lights))
    }
    (folder / "site.json").write_text(json.dumps(described))
    return folder


def drive(run_node: RunNode, site: Path, steps: Sequence[Step], **job: Any) -> list[Any]:
    """Open the page of a folder, do the steps of page.mjs, and return what each gave."""
    text, found = site.parent / f"{site.name}.job.json", site.parent / f"{site.name}.found.json"
    text.write_text(json.dumps({"site": str(site), "steps": steps, "width": 640, "height": 480} | job))
    run_node("page.mjs", text, found)
    results: list[Any] = json.loads(found.read_text())
    return results


def states(run_node: RunNode, site: Path, *between: list[Any], **job: Any) -> list[dict[str, Any]]:
    """The state of the page when it is ready, and after each of the steps."""
    steps: list[list[Any]] = [["ready"], ["state"]]
    for step in between:
        steps += [step, ["rest"], ["state"]]
    return [found for found in drive(run_node, site, steps, **(BACKENDS["webgl"] | job)) if found]


def relative_rms(found: Any, expected: np.ndarray) -> float:
    difference = np.reshape(np.asarray(found, np.float64), expected.shape) - expected
    return float(np.sqrt(np.square(difference).sum() / np.square(expected).sum()))


def camera_of(camera: Camera, samples: int) -> dict[str, Any]:
    """A camera as page.mjs takes it, of `samples`² pixels in place of each."""
    points = {name: getattr(camera, name).tolist() for name in ("eye", "target", "up")}
    return points | {"fov": camera.fov, "width": samples * camera.width, "height": samples * camera.height}
