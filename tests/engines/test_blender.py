"""Blender reads the exported file, and its pictures, by `engines/blender_material.py`, are those of `prtbake shade`."""

import json
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import prt_bake as prt
from formats.image import read_image
from formats.scene.units import MILLIMETRES
from tests.engines.conftest import HERE
from tests.engines.pictures import IRRADIANCE, SUN, Situation, relative_rms, soft_asset, write_users_file
from tests.export.glb_reader import read_glb

TO_BLENDER = {"y": np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]), "z": np.eye(3)}
MOST = 0.015


@pytest.fixture
def sky() -> Path:
    return Path(prt.example("sky.hdr"))


def run_blender(python: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    command = [str(python), str(HERE / "blender_scene.py"), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)


def job_of(situation: Situation, engine: str, glb: Path, sky: Path, out: Path) -> dict[str, Any]:
    asset, camera = situation.asset, situation.camera
    to_blender, scale = TO_BLENDER[asset.up], MILLIMETRES.get(asset.unit, 1000) / 1000
    light: dict[str, Any] = {}
    if situation.light == "sun":
        light = {"sun": (to_blender @ SUN[asset.up]).tolist(), "irradiance": IRRADIANCE}
    elif situation.light == "sky":
        light = {"sky": str(sky), "turn": situation.sky_turn}
    eye, target = ((scale * to_blender @ point).tolist() for point in (camera.eye, camera.target))
    return {
        "glb": str(glb),
        "camera": {"eye": eye, "target": target, "fov": camera.fov},
        "light": light,
        "turn": situation.turn,
        "engine": engine,
        "picture": f"{out}.exr",
        "attributes": f"{out}.npz",
    }


def rendered(blender: Path, jobs: list[dict[str, Any]], folder: Path) -> None:
    (folder / "jobs.json").write_text(json.dumps(jobs))
    done = run_blender(blender, folder / "jobs.json")
    assert done.returncode == 0, done.stderr


def difference(job: dict[str, Any], situation: Situation, sky: Path) -> float:
    return relative_rms(read_image(job["picture"])[..., :3], situation.picture(sky))


CASES = [  # asset, light, turn of the object, turn of the sky, engine
    ("y", "file", 150.0, 0.0, "CYCLES"),
    ("y", "sun", 40.0, 0.0, "CYCLES"),
    ("y", "sky", 40.0, 75.0, "CYCLES"),
    ("z", "file", 0.0, 0.0, "CYCLES"),
    ("z", "sun", 40.0, 0.0, "CYCLES"),
    ("z", "sky", 0.0, 75.0, "CYCLES"),
    ("onto", "sky", 40.0, 75.0, "CYCLES"),
    ("onto scaled", "sky", 40.0, 75.0, "CYCLES"),
    ("y", "sky", 40.0, 75.0, "BLENDER_EEVEE_NEXT"),
]
USERS = {"onto": (1.0, 1.0, 1.0), "onto scaled": (1.0, -2.0, 0.5)}
"""Scales of the nodes of files that are exported onto."""


def test_pictures_and_attributes(blender: Path, sky: Path, tmp_path: Path) -> None:
    assets = {"y": soft_asset("y", "dm"), "z": soft_asset("z", "cm")}
    assets |= dict.fromkeys(USERS, soft_asset("y", "m"))
    for name, asset in assets.items():
        onto = None
        if name in USERS:
            onto = tmp_path / f"{name}.user.glb"
            write_users_file(asset.mesh, onto, USERS[name])
        prt.export_gltf(asset, tmp_path / f"{name}.glb", onto=onto)
    situations = [Situation(assets[name], light, turn, sky_turn) for name, light, turn, sky_turn, _ in CASES]
    jobs = [
        job_of(situation, case[4], tmp_path / f"{case[0]}.glb", sky, tmp_path / f"out{number}")
        for number, (case, situation) in enumerate(zip(CASES, situations, strict=True))
    ]
    rendered(blender, jobs, tmp_path)
    for case, job, situation in zip(CASES, jobs, situations, strict=True):
        assert difference(job, situation, sky) <= MOST, case
        if case[0] in USERS:
            continue  # two primitives of the file are one mesh of Blender
        imported = np.load(job["attributes"])
        stored = read_glb(Path(job["glb"])).attributes
        names = [name for name in stored if name.startswith("_PRT")]
        assert len(names) == 144
        for name in names:
            np.testing.assert_array_equal(imported[name], stored[name])


def test_one_light_folded_in(blender: Path, sky: Path, tmp_path: Path) -> None:
    asset = soft_asset()
    situation = Situation(asset, "file")
    light = prt.light_for(asset, prt.read_lighting(str(sky)), suns="plain").whole
    prt.export_gltf(asset, tmp_path / "lit.glb", light=light)
    job = job_of(situation, "CYCLES", tmp_path / "lit.glb", sky, tmp_path / "out")
    rendered(blender, [job], tmp_path)
    assert difference(job, situation, sky) <= MOST


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"quantize": "int8"}, "Blender drops int8: export without --quantize"),
        ({"degree": 7}, "export with --degree 6"),
    ],
)
def test_what_blender_cannot_show_is_refused(
    blender: Path, sky: Path, tmp_path: Path, options: dict[str, Any], says: str
) -> None:
    asset = soft_asset()
    prt.export_gltf(asset, tmp_path / "spot.glb", **options)
    job = job_of(Situation(asset, "file"), "CYCLES", tmp_path / "spot.glb", sky, tmp_path / "out")
    (tmp_path / "jobs.json").write_text(json.dumps([job]))
    done = run_blender(blender, tmp_path / "jobs.json")
    assert done.returncode == 1
    assert says in done.stderr
