"""Godot's web runtime loads the exported file by `engines/godot`, and its pictures are those of `prtbake shade`."""

import base64
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import prt_bake as prt
from formats.scene.units import MILLIMETRES
from tests import ROOT
from tests.engines.conftest import HERE, RunNode
from tests.engines.pictures import IRRADIANCE, PIXELS, SUN, Situation, relative_rms, soft_asset, write_users_file

MOST = 0.015
ACROSS = 4  # pixels of Godot along a side of one of the picture: it resolves edges after the sRGB curve
SIZE = ACROSS * PIXELS
TO_GODOT = {"y": np.eye(3), "z": np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])}
PROJECT = f"""config_version=5

[application]

config/name="prtbake"
run/main_scene="res://test.tscn"
boot_splash/show_image=false

[display]

window/size/viewport_width={SIZE}
window/size/viewport_height={SIZE}

[rendering]

renderer/rendering_method="gl_compatibility"
"""
SCENE = """[gd_scene load_steps=2 format=3]

[ext_resource type="Script" path="res://godot_scene.gd" id="1"]

[node name="Test" type="Node"]
script = ExtResource("1")
"""
PAGE = f"""<!DOCTYPE html>
<canvas id="canvas" width="{SIZE}" height="{SIZE}"></canvas>
<script src="godot/index.js"></script>
<script>
window.result = new Promise((resolve, reject) => {{
    const seen = setInterval(() => window.pictures && (clearInterval(seen), resolve(window.pictures)), 50);
    const canvas = document.getElementById("canvas");
    const settings = {{ canvas, executable: "godot/index", mainPack: "project.pck", canvasResizePolicy: 0, args: [] }};
    new Engine(settings).startGame().catch(reject);
}});
</script>
"""


def pack(files: dict[str, bytes]) -> bytes:
    """A package of Godot, version 3 of its format: a header, the files, and a directory."""
    base, flags, version = 112, 2, (4, 4, 0)  # offsets count from the base
    content, directory = b"", struct.pack("<I", len(files))
    for name, data in files.items():
        path = name.encode() + b"\0" * (-len(name) % 4)
        directory += struct.pack("<I", len(path)) + path + struct.pack("<QQ16sI", len(content), len(data), b"", 0)
        content += data + b"\0" * (-len(data) % 16)
    header = struct.pack("<4sIIIIIQQ", b"GDPC", 3, *version, flags, base, base + len(content))
    return header.ljust(base, b"\0") + content + directory


def run_godot(run_node: RunNode, folder: Path, glbs: list[Path], jobs: list[dict[str, Any]]) -> list[np.ndarray]:
    """Return linear pictures [PIXELS,PIXELS,3]."""
    scripts = [path for path in (ROOT / "engines/godot").iterdir() if path.name != "project.godot"]
    files = {path.name: path.read_bytes() for path in [*scripts, HERE / "godot_scene.gd", *glbs]}
    files |= {"project.godot": PROJECT.encode(), "test.tscn": SCENE.encode(), "job.json": json.dumps(jobs).encode()}
    files[".godot/global_script_class_cache.cfg"] = b"list=[]\n"
    (folder / "project.pck").write_bytes(pack(files))
    (folder / "index.html").write_text(PAGE)
    return [decoded(picture) for picture in run_node("godot.mjs", folder)]


def decoded(picture: str) -> np.ndarray:
    values = np.frombuffer(base64.b64decode(picture), np.uint8) / 255.0
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    return linear.reshape(PIXELS, ACROSS, PIXELS, ACROSS, 3).mean(axis=(1, 3))


def job_of(situation: Situation, glb: str, sky: Path) -> dict[str, Any]:
    asset, camera = situation.asset, situation.camera
    to_godot, scale = TO_GODOT[asset.up], MILLIMETRES[asset.unit] / 1000.0
    energy = max(IRRADIANCE) / np.pi
    coefficients = prt.project_environment(prt.read_environment(sky))
    return {
        "glb": f"res://{glb}",
        "turn": situation.turn,
        "mirrored": situation.mirrored,
        "eye": (scale * to_godot @ camera.eye).tolist(),
        "target": (scale * to_godot @ camera.target).tolist(),
        "fov": camera.fov,
        "sun": (to_godot @ SUN[asset.up]).tolist() if situation.light == "sun" else [],
        "colour": (np.array(IRRADIANCE) / max(IRRADIANCE)).tolist(),
        "energy": energy,
        "sky": prt.rotate_light(coefficients, situation.sky_turn).tolist() if situation.light == "sky" else [],
    }


CASES = [  # asset, light, turn of the object, turn of the sky, form, perhaps mirrored
    ("y", "file", 150.0, 0.0, "float"),
    ("y", "sun", 40.0, 0.0, "float"),
    ("y", "sky", 40.0, 75.0, "float"),
    ("y", "sky", 40.0, 75.0, "int8"),
    ("y", "file", 0.0, 0.0, "light"),
    ("y", "sun", 40.0, 0.0, "float.reordered"),
    ("y", "sun", 40.0, 0.0, "int8.reordered"),
    ("onto", "sky", 40.0, 75.0, "float"),
    ("z", "sun", 40.0, 0.0, "int8"),
    ("z", "sky", 40.0, 75.0, "float"),
    ("y", "file", 40.0, 0.0, "float", True),
    ("y", "sun", 40.0, 0.0, "float", True),
    ("y", "sky", 40.0, 75.0, "int8", True),
]


@pytest.mark.usefixtures("chromium")
def test_pictures(run_node: RunNode, tmp_path: Path) -> None:
    sky = Path(prt.example("sky.hdr"))
    assets = {"y": soft_asset("y", "dm"), "z": soft_asset("z", "cm"), "onto": soft_asset("y", "m")}
    write_users_file(assets["onto"].mesh, tmp_path / "user.glb", (1.0, 2.0, 0.5))
    prt.export_gltf(assets["onto"], tmp_path / "onto.float.glb", onto=tmp_path / "user.glb")
    for up in ("y", "z"):
        asset = assets[up]
        prt.export_gltf(asset, tmp_path / f"{up}.float.glb")
        prt.export_gltf(asset, tmp_path / f"{up}.int8.glb", quantize="int8")
        light = prt.light_for(asset, prt.read_lighting(str(sky), up=up), suns="plain").whole
        prt.export_gltf(asset, tmp_path / f"{up}.light.glb", light=light)
    for form in ("float", "int8"):
        order = run_node("reordered.mjs", tmp_path / f"y.{form}.glb", tmp_path / f"y.{form}.reordered.glb")
        assert order["before"] != order["after"]
    situations = [
        Situation(assets[name], light, turn, sky_turn, *mirrored) for name, light, turn, sky_turn, _, *mirrored in CASES
    ]
    jobs = [
        job_of(situation, f"{case[0]}.{case[4]}.glb", sky) for case, situation in zip(CASES, situations, strict=True)
    ]
    pictures = run_godot(run_node, tmp_path, sorted(tmp_path.glob("*.glb")), jobs)
    for case, situation, picture in zip(CASES, situations, pictures, strict=True):
        assert relative_rms(picture, situation.picture(sky)) <= MOST, case
