"""The export to Mitsuba: nested parts, errors, and files that agree with the dictionary.

test_mitsuba_reference compares its renderings.
"""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import prt_bake as prt
from formats.errors import QueryError, SceneError, StorageError
from formats.scene import Scene
from tests.tracer.nested_scenes import CLEAR, nested_scene
from tests.tracer.scenes import make_scene, moved, sphere

BALL = sphere(1)
MILK: dict[str, Any] = {"sigma_t": [1.0, 2.0, 3.0], "albedo": 0.9, "phase_g": 0.3}


def glass_of_milk(folder: Path) -> Scene:
    """Write a smooth glass of milk with a bubble and a stone in it."""
    milk = {"name": "milk", "mesh": moved(BALL, 0.9), "interface": {"eta": 1.33, "roughness": 0.2}, "medium": MILK}
    bubble = {"name": "bubble", "mesh": moved(BALL, 0.2, 0.3), "in": "milk", "interface": {"eta": 1.0}}
    stone = {"name": "stone", "mesh": moved(BALL, 0.2, -0.3), "in": "milk", "surface": "diffuse", "reflectance": 0.4}
    return nested_scene(folder, BALL, CLEAR, (milk, bubble, stone), eta=1.5)


def test_every_boundary_has_the_indices_and_media_of_both_sides(tmp_path: Path) -> None:
    world = prt.mitsuba_dictionary(glass_of_milk(tmp_path), tmp_path)
    boundaries = [world[f"shape_{index}"]["bsdf"] for index in range(4)]
    assert boundaries[0] == {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}
    assert (boundaries[1]["type"], boundaries[1]["int_ior"], boundaries[1]["ext_ior"]) == ("roughdielectric", 1.33, 1.5)
    assert boundaries[2] == {"type": "dielectric", "int_ior": 1.0, "ext_ior": 1.33}
    assert boundaries[3]["type"] == "twosided"
    sides = [[world[f"shape_{index}"].get(side) for side in ("interior", "exterior")] for index in range(4)]
    milk = {"type": "ref", "id": "medium_1"}
    assert sides == [[None, None], [milk, None], [None, milk], [None, milk]]
    assert world["integrator"]["type"] == "volpathmis"


def grids_far_away(folder: Path) -> Scene:
    sigma_t = np.random.default_rng(1).uniform(1.0, 3.0, (3, 4, 5))
    return make_scene(folder, moved(BALL, 1.0, 7.0), sigma_t=sigma_t, albedo=0.8, eta=1.4, roughness=0.3)


@pytest.mark.parametrize("write", [grids_far_away, glass_of_milk])
def test_files_agree_with_the_dictionary(tmp_path: Path, write: Callable[[Path], Scene]) -> None:
    """The command's scene.xml, in a moved folder, and the dictionary render the same picture for one seed."""
    import mitsuba as mi

    mi.set_variant("scalar_rgb")
    from prt_bake.cli.main import main

    (tmp_path / "scene").mkdir()
    scene = write(tmp_path / "scene")
    assert main(["export", str(scene.path), "-o", str(tmp_path / "out" / "deep")]) == 0
    (tmp_path / "out" / "deep").rename(tmp_path / "moved")
    world = mi.load_file(str(tmp_path / "moved" / "scene.xml"))
    (tmp_path / "other").mkdir()
    same = mi.load_dict(prt.mitsuba_dictionary(scene, tmp_path / "other"))
    eye = mi.load_dict(
        {
            "type": "perspective",
            "film": {"type": "hdrfilm", "width": 24, "height": 16},
            "to_world": mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]),
        }
    )
    pictures = [np.array(mi.render(w, sensor=eye, spp=4, seed=3, integrator=w.integrator())) for w in (world, same)]
    np.testing.assert_allclose(*pictures, rtol=1e-5)  # the order of summation depends on threads
    assert pictures[0].std() > 0.01
    assert np.array(world.sensors()[0].film().size()).tolist() == [640, 480]


def test_unsupported_scenes_are_refused(tmp_path: Path) -> None:
    out = {"name": "out", "mesh": moved(BALL, 0.5, [0.8, 0.0, 0.0])}
    left, right = ({"name": n, "mesh": moved(BALL, 0.3, [x, 0.0, 0.0])} for n, x in (("left", -0.1), ("right", 0.1)))
    cases = [
        (((out,)), {}, "'out' sticks out of 'object'"),
        ((left, right), {}, "'left' and 'right' overlap"),
        ((), {"eta": 1.5, "roughness": 0.2, "energy_compensation": True}, "energy_compensation"),
    ]
    for inside, interface, message in cases:
        scene = nested_scene(tmp_path, BALL, CLEAR, inside, **interface)
        with pytest.raises(SceneError, match=message):
            prt.mitsuba_dictionary(scene, tmp_path)


def test_wrong_arguments_are_named(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, BALL)
    with pytest.raises(StorageError, match=r"nowhere: there is no such folder"):
        prt.mitsuba_dictionary(scene, tmp_path / "nowhere")
    with pytest.raises(QueryError, match=r"incident: expected a unit vector \[3\], found \[0.0, 0.0, 2.0\]"):
        prt.mitsuba_dictionary(scene, tmp_path, incident=[0, 0, 2])


def test_exporting_needs_no_mitsuba(tmp_path: Path) -> None:
    scene = glass_of_milk(tmp_path)
    program = (
        "import sys\nsys.modules['mitsuba'] = sys.modules['drjit'] = None\nimport prt_bake as prt\n"
        f"prt.mitsuba_dictionary(prt.load_scene({str(scene.path)!r}), {str(tmp_path)!r}, incident=[0, 0, 1])\n"
    )
    root = Path(prt.__file__).parents[1]
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=root, check=False)
    assert (ran.returncode, ran.stderr) == (0, "")
