"""X.exr as three.js loads it, and as the shaders of `engines/` show it."""

import json
from pathlib import Path

import numpy as np

import prt_bake as prt
from prt_bake.export.engine_form import engine_form
from tests.engines.conftest import RunNode


def test_three_loads_every_half_with_the_bottom_row_first(spot: Path, run_node: RunNode, tmp_path: Path) -> None:
    asset = prt.read_asset(spot / "spot.h5")
    prt.export_exr(asset, tmp_path / "spot.exr")
    layout = json.loads((tmp_path / "spot.json").read_text("utf-8"))["texture"]
    found = run_node("read_exr.mjs", tmp_path / "spot.exr")
    assert (found["width"], found["height"]) == (layout["width"], layout["height"])
    rgba = np.array(found["data"], np.uint16).reshape(found["height"], found["width"], 4)
    runs = rgba[::-1, :, :3].reshape(-1, layout["texels_per_vertex"], 3)
    form = engine_form(asset).coefficients.astype(np.float16).view(np.uint16)
    assert np.array_equal(runs[: len(form)], form.reshape(len(form), -1, 3))
