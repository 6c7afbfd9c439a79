"""X.exr as three.js loads it, and as the shaders of `engines/` show it."""

import json
from pathlib import Path

import numpy as np
import pytest

import prt_bake as prt
from prt_bake.export.engine_form import engine_form
from tests.engines.conftest import RunNode
from tests.engines.test_shaders import Scene, bits, degrees, example, in_browser
from tests.export.test_exr import read


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


@pytest.mark.usefixtures("chromium")
def test_the_shader_passes_the_selftest_of_the_files(spot: Path, run_node: RunNode, tmp_path: Path) -> None:
    prt.export_exr(prt.read_asset(spot / "spot.h5"), tmp_path / "x.exr")
    texture, description, attributes = read(tmp_path / "x.exr")
    test = {name: np.array(values) for name, values in description["selftest"].items()}
    job = {
        "shader": degrees(example("glsl"), Scene(3, 2)),
        "attributes": {
            "position": {"size": 3, "values": (-10 * test["outgoing"]).ravel().tolist()},
            "texel": {"size": 2, "values": attributes["TEXCOORD_1"][test["vertex"]].ravel().tolist()},
        },
        "uniforms": {
            "object_to_world": {"kind": "Matrix4fv", "values": np.eye(4).ravel().tolist()},
            "sun": {"kind": "3fv", "values": [0, 0, 1]},
            "sky": {"kind": "3fv", "values": test["light"].ravel().tolist()},
        },
        "textures": [
            {
                "name": "prt_texture",
                "height": len(texture),
                "width": texture.shape[1],
                "format": "half",
                "values": bits(texture),
            }
        ],
        "output": "radiance",
        "count": len(test["vertex"]),
    }
    (found,) = in_browser(run_node, tmp_path, [job])
    np.testing.assert_allclose(found, np.maximum(test["radiance"], 0), atol=1e-5 * test["radiance"].max())
