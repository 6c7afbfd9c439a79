"""The paper's scenes: every one is valid, its parts nest, and its meshes are what the formulas generate."""

import subprocess
import sys
from fnmatch import fnmatch

import numpy as np
import pytest

from formats.image import read_data, read_image
from formats.mesh import build_mesh, check_mesh, read_mesh, write_mesh
from formats.scene import read_scene
from prt_bake.geometry.nesting import protruding_parts, winding_numbers
from prt_bake.inspection.files import find_remarks
from prt_bake.trainer.scene_warnings import training_warning
from tests import ROOT
from tests.shapes import ball
from tests.tracer.scenes import make_scene

pytestmark = pytest.mark.statistics

SCENES = ROOT / "scenes"
FILES = sorted(SCENES.glob("*/*.toml"))
STANFORD = {SCENES / name for name in ("dragon/dragon.toml", "paperweight/bunny.toml", "lucy/lucy.toml")}
COMPLETE = [path for path in FILES if path not in STANFORD]


def named(path):
    return str(path.relative_to(SCENES))


def run(module, *arguments):
    command = [sys.executable, "-m", f"scenes.{module}", *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


def test_all_scenes_exist():
    folders = {path.parent.name for path in COMPLETE}
    assert folders == {"grape", "dragon", "paperweight", "drink", "lucy", "head", "translucency", "matched"}
    assert set(FILES) > STANFORD
    assert len([path for path in COMPLETE if path.parent.name == "translucency"]) == 6


@pytest.mark.parametrize("path", COMPLETE, ids=named)
def test_a_scene_is_valid_and_its_parts_nest(path):
    scene = read_scene(path)
    for part in scene.parts:
        assert check_mesh(part.mesh_path) == []
        assert not part.flipped
    assert not protruding_parts(scene.parts)


@pytest.mark.parametrize("path", sorted(STANFORD), ids=named)
def test_a_scene_of_a_scan_is_valid_with_a_prepared_mesh(path, tmp_path):
    for other in path.parent.iterdir():
        (tmp_path / other.name).write_bytes(other.read_bytes())
    text = path.read_text()
    scan = next(word for word in text.replace('"', " ").split() if word.startswith("stanford_"))
    options = next(line for line in text.splitlines() if "scenes.prepare" in line).split(" --", 1)[1]
    made = run("prepare", ROOT / "prt_bake/shipped/spot.obj", tmp_path / scan, *f"--{options}".split())
    assert (made.returncode, made.stderr) == (0, "")
    assert not protruding_parts(read_scene(tmp_path / path.name).parts)


def test_the_grape_is_textured_and_has_two_seeds():
    grape, left, right = read_scene(SCENES / "grape/grape.toml").parts
    assert grape.roughness.ndim == 2
    assert 0.09 < grape.roughness.min() < 0.2 < 0.3 < grape.roughness.max() < 0.46
    assert left.diffuse.ndim == right.diffuse.ndim == 3
    assert not grape.mesh.seamless
    # The seeds do not touch.
    assert (winding_numbers(left.mesh, right.mesh.positions) < 0.5).all()
    assert (winding_numbers(right.mesh, left.mesh.positions) < 0.5).all()


def test_the_drink_nests_three_deep():
    scene = read_scene(SCENES / "drink/drink.toml")
    assert [part.parent for part in scene.parts] == [-1, 0, 1, 1]
    assert [part.eta for part in scene.parts] == [1.5, 1.33, 1.31, 1.31]
    glass, liquid, left, right = scene.parts
    assert 0 < glass.mesh.bounds[1, 1] - liquid.mesh.bounds[1, 1] < 0.15
    assert (winding_numbers(left.mesh, right.mesh.positions) < 0.5).all()
    assert (winding_numbers(right.mesh, left.mesh.positions) < 0.5).all()


def test_the_paperweight_s_inner_boundary_is_index_matched():
    for name in ("cow", "cow_rough"):
        cube, cow = read_scene(SCENES / f"paperweight/{name}.toml").parts
        assert cow.eta == cube.eta == 1.5
        assert cow.medium.sigma_t.shape[3] == 3
        assert (cube.roughness == 0) == (name == "cow")


def test_check_remarks_that_rough_clear_glass_is_hard_to_learn():
    hard = {
        name: any("learn it poorly" in remark for remark in find_remarks(SCENES / f"{name}.toml"))
        for name in ("paperweight/cow", "paperweight/cow_rough", "dragon/serpent", "matched/spot")
    }
    assert [name for name, remarked in hard.items() if remarked] == ["paperweight/cow_rough"]


@pytest.mark.parametrize(
    ("sigma_t", "roughness", "eta", "hard"), [(0.5, 0.1, 1.5, True), (10.0, 0.1, 1.5, False), (0.5, 0.1, 1.0, False)]
)
def test_forward_scattered_light_is_not_unscattered(tmp_path, sigma_t, roughness, eta, hard):
    """A ball of diameter 2 with strong forward scattering."""
    scene = make_scene(tmp_path, ball(3), sigma_t=sigma_t, albedo=0.99, phase_g=0.9, roughness=roughness, eta=eta)
    assert (training_warning(scene) is not None) == hard


def test_the_series_doubles_its_extinction():
    dense = [read_scene(SCENES / f"translucency/spot_{k}.toml").sigma_t for k in range(1, 7)]
    assert dense == [2.0 * 2**k for k in range(6)]


def test_the_meshes_are_reproducible(tmp_path):
    for name in ("grape", "dragon", "paperweight", "drink", "lucy"):
        made = run("make", "--out", tmp_path, "--only", name)
        assert (made.returncode, made.stderr) == (0, "")
        for fresh in (tmp_path / name).iterdir():
            kept = SCENES / name / fresh.name
            if fresh.suffix == ".obj":
                np.testing.assert_array_equal(read_mesh(fresh).faces, read_mesh(kept).faces)
                np.testing.assert_allclose(read_mesh(fresh).positions, read_mesh(kept).positions, atol=1.1e-4)
            else:
                np.testing.assert_allclose(read_data(fresh)[..., 0], read_data(kept)[..., 0], atol=1.1 / 255)


def test_the_head_is_reproducible(tmp_path):
    made = run("make", "--out", tmp_path, "--only", "head")
    assert (made.returncode, made.stderr) == (0, "")
    fresh, kept = read_mesh(tmp_path / "head/head.obj"), read_mesh(SCENES / "head/head.obj")
    assert 3000 <= len(kept.faces) <= 7000
    np.testing.assert_allclose(fresh.bounds, kept.bounds, atol=2e-4)
    assert fresh.face_areas.sum() == pytest.approx(kept.face_areas.sum(), rel=1e-3)
    np.testing.assert_array_equal(read_image(tmp_path / "head/sun.hdr"), read_image(SCENES / "head/sun.hdr"))


def test_the_ears_are_thin():
    """The outer intervals of a line from ear to ear are short."""
    mesh = read_mesh(SCENES / "head/head.obj")
    x = np.linspace(-0.76, 0.76, 400)
    line = np.stack([x, np.full_like(x, 0.28), np.full_like(x, 0.35)], axis=1)
    inside = winding_numbers(mesh, line) > 0.5
    runs = np.flatnonzero(np.diff(np.concatenate([[0], inside.astype(int), [0]])))
    lengths = np.diff(runs)[::2] * (x[1] - x[0])
    assert len(lengths) == 3  # an ear, the head, an ear
    assert lengths[0] < 0.25
    assert lengths[2] < 0.25


def test_prepare_refuses_an_open_mesh(tmp_path):
    ball = read_mesh(SCENES / "paperweight/cube.obj")
    write_mesh(build_mesh(ball.positions, ball.faces[1:]), tmp_path / "open.ply")
    made = run("prepare", tmp_path / "open.ply", tmp_path / "out.ply")
    assert made.returncode == 1
    assert "3 edges are open or inconsistent; close the holes first" in made.stderr
    assert not (tmp_path / "out.ply").exists()


def is_ignored(path):
    """Whether .gitignore matches a file, by its name, folder or path."""
    place = path.relative_to(ROOT)
    for pattern in (ROOT / ".gitignore").read_text().split():
        if pattern.startswith("/"):
            found = place.match(pattern[1:].rstrip("/"))
        elif pattern.endswith("/"):
            found = any(fnmatch(folder, pattern[:-1]) for folder in place.parts[:-1])
        else:
            found = fnmatch(place.name, pattern)
        if found:
            return True
    return False


def test_the_scenes_are_small_and_contain_no_scan():
    kept = [path for path in SCENES.rglob("*") if path.is_file() and not is_ignored(path)]
    assert len(kept) > 30
    assert not [path for path in kept if "stanford" in path.name.lower()]
    # Models and their reports have a separate limit.
    assert sum(path.stat().st_size for path in kept if path.parent.name != "models") < 1_500_000
    assert is_ignored(SCENES / "dragon/stanford_dragon.ply")
    assert not is_ignored(SCENES / "dragon/dragon.obj")
