"""Test sets: coordinates and lights as independent readers understand them, light that adds up, and continued runs."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from formats.errors import FormatError, LightError, StorageError
from formats.image import read_layers, write_image
from formats.mesh import build_mesh, write_mesh
from formats.scene import Scene, read_scene
from prt_bake.lights.lighting import read_lighting
from prt_bake.olat.pictures import Coordinates, held_out_skies, pictures
from prt_bake.olat.render import OlatSet
from prt_bake.olat.settings import OlatSettings
from prt_bake.rendering.scene import Rendering, render_scene
from tests.rendering.pictures import mean_z, z_score
from tests.shapes import ball

SMALL = OlatSettings(views=2, lights=2, test_views=1, test_lights=1, width=20, height=14, spp=8)


def _scene(folder: Path, up: str = "y") -> Scene:
    """A stretched ball off the origin, in units of its own."""
    round_one = ball(2)
    stretched = np.array([5.0, -2.0, 3.0]) + round_one.positions * [2.0, 0.7, 1.1]
    write_mesh(build_mesh(stretched, round_one.faces), folder / "bean.ply")
    (folder / "bean.toml").write_text(
        f'[object]\nmesh = "bean.ply"\nup = "{up}"\n[interface]\neta = 1.3\nroughness = 0.4\n'
        "[medium]\nsigma_t = 2.0\nalbedo = 0.9\n"
    )
    return read_scene(folder / "bean.toml")


def _sky(folder: Path) -> Path:
    write_image(folder / "even.exr", np.full((8, 16, 3), 7.0, np.float32))
    return folder / "even.exr"


def _make(scene: Scene, folder: Path, settings: OlatSettings = SMALL) -> OlatSet:
    olat = OlatSet(scene, folder, settings, [_sky(scene.path.parent)])
    assert olat.write(lambda: False, lambda _share, _text: None) == len(olat.pictures)
    return olat


def _read(folder: Path, frame: dict) -> Rendering:
    found = read_layers(folder / f"{frame['file_path']}.exr")
    numbers = {"walks": 0, "seconds": 0.0, "spp": 0, "passes": 0, "complete": True, "history": np.zeros((0, 3))}
    return Rendering(found.image, found.layers["error"], found.layers["A"], **numbers)


@pytest.mark.parametrize("up", ["y", "z"])
def test_a_reader_of_blender_cameras_finds_the_object_where_it_is_seen(tmp_path: Path, up: str) -> None:
    scene = _scene(tmp_path, up)
    _make(scene, tmp_path / "set")
    contents = json.loads((tmp_path / "set" / "transforms_train.json").read_text())
    matrix = np.array(json.loads((tmp_path / "set" / "dataset.json").read_text())["coordinates"]["scene_to_dataset"])
    points = scene.mesh.positions @ matrix[:3, :3].T + matrix[:3, 3]
    assert np.abs(points).max() == pytest.approx(0.5)
    assert np.linalg.det(matrix[:3, :3]) > 0.0
    up_there = matrix[:3, :3] @ ([0.0, 1.0, 0.0] if up == "y" else [0.0, 0.0, 1.0])
    assert up_there[2] == pytest.approx(np.linalg.norm(up_there))
    for frame in contents["frames"]:
        coverage = _read(tmp_path / "set", frame).coverage
        height, width = coverage.shape
        focal = 0.5 * width / math.tan(0.5 * contents["camera_angle_x"])
        seen = np.linalg.inv(frame["transform_matrix"]) @ np.column_stack([points, np.ones(len(points))]).T
        assert (seen[2] < -contents["camera_near"]).all()
        assert (seen[2] > -contents["camera_far"]).all()
        columns = width / 2 + focal * seen[0] / -seen[2]
        rows = height / 2 - focal * seen[1] / -seen[2]
        met = np.argwhere(coverage > 0.0)
        assert np.abs(met.min(axis=0) + 0.5 - [rows.min(), columns.min()]).max() < 1.0
        assert np.abs(met.max(axis=0) + 0.5 - [rows.max(), columns.max()]).max() < 1.0
        assert np.mean(coverage[rows.astype(int), columns.astype(int)] > 0.0) > 0.9


def test_no_camera_and_no_light_is_in_both_sets_and_no_picture_shares_its_random_numbers(tmp_path: Path) -> None:
    scene = _scene(tmp_path)
    skies = held_out_skies([_sky(tmp_path)], "y")
    settings = OlatSettings(views=8, lights=16, test_views=4, test_lights=8)
    found = list(pictures(scene, settings, skies))
    assert len(found) == 8 * 16 + 4 * 8 + 4
    assert len({picture.seed for picture in found}) == len({picture.name for picture in found}) == len(found)
    lights, eyes = ({name: set() for name in ("train", "test", "held_out_skies")} for _ in range(2))
    for picture in found:
        eyes[picture.set].add(tuple(picture.camera.eye))
        if picture.direction is not None:
            assert np.linalg.norm(picture.direction) == pytest.approx(1.0)
            lights[picture.set].add(tuple(picture.direction))
    assert len(lights["train"]) == 16
    assert len(lights["test"]) == 8
    assert len(eyes["train"]) == 8
    assert not lights["train"] & lights["test"]
    assert not eyes["train"] & eyes["test"]
    assert eyes["held_out_skies"] == eyes["test"]
    assert np.linalg.norm(np.mean(list(lights["train"]), axis=0)) < 0.1


@pytest.mark.parametrize("subsurface", [False, True])
def test_a_picture_is_that_of_the_scene_under_the_light_of_its_frame(tmp_path: Path, subsurface: bool) -> None:
    scene = _scene(tmp_path)
    settings = OlatSettings(1, 1, 1, 1, 16, 16, 64, seed=3, subsurface=subsurface)
    olat = _make(scene, tmp_path / "set", settings)
    (frame,) = json.loads((tmp_path / "set" / "transforms_train.json").read_text())["frames"]
    turn = np.array(json.loads((tmp_path / "set" / "dataset.json").read_text())["coordinates"]["scene_to_dataset"])
    towards = np.linalg.solve(turn[:3, :3], frame["light_direction"])
    red, green, blue = frame["light_irradiance"]
    assert red == green == blue == pytest.approx(math.pi)  # as README.md says
    light = read_lighting(f"sun:{','.join(map(repr, towards.tolist()))}:{red},{green},{blue}")
    shown = {"shown": "scattered"} if subsurface else {"reflection": True}
    other = render_scene(scene, light, olat.pictures[0].camera, 64, 99, background=False, **shown)
    picture = _read(tmp_path / "set", frame)
    shows = "unscattered light left out" if subsurface else "light reflected at the surface"
    assert json.loads((tmp_path / "set" / "dataset.json").read_text())["shows"] == f"subsurface light, {shows}"
    assert abs(z_score(picture, other)) < 4.0
    assert np.abs(mean_z(picture, other)).max() < 4.0
    far, intensity = np.array(frame["pl_pos"]), np.array(frame["pl_intensity"])
    assert np.allclose(far / np.linalg.norm(far), frame["light_direction"])
    assert np.allclose(intensity / np.linalg.norm(far) ** 2, frame["light_irradiance"])
    assert frame["light_positions"] == [frame["pl_pos"]]
    assert [row[3] for row in frame["transform_matrix_sun"]][:3] == frame["pl_pos"]


def test_the_lights_of_all_directions_add_up_to_a_uniform_sky(tmp_path: Path) -> None:
    scene = _scene(tmp_path)
    _make(scene, tmp_path / "set", OlatSettings(1, 1, 1, 32, 12, 12, 16))
    frames = json.loads((tmp_path / "set" / "transforms_test.json").read_text())["frames"]
    (under_sky,) = json.loads((tmp_path / "set" / "transforms_held_out_skies.json").read_text())["frames"]
    assert np.all(read_layers(tmp_path / "set" / under_sky["environment"]).image == 1.0)
    sky = _read(tmp_path / "set", under_sky)
    inside = sky.coverage == 1
    means = np.array([_read(tmp_path / "set", frame).image[inside].mean() for frame in frames])
    radiance = 4.0 * math.pi * means / frames[0]["light_irradiance"][0]
    deviation = radiance.std(ddof=1) / math.sqrt(len(radiance))
    assert deviation < 0.1 * radiance.mean()
    assert abs(radiance.mean() - sky.image[inside].mean()) < 3.0 * deviation


def test_a_stopped_run_continues_to_the_same_files(tmp_path: Path) -> None:
    scene = _scene(tmp_path)
    _make(scene, tmp_path / "whole")
    stopped = OlatSet(scene, tmp_path / "set", SMALL, [_sky(tmp_path)])
    calls = iter(range(1000))
    done = stopped.write(lambda: next(calls) > 9, lambda _share, _text: None)
    assert 0 < done < len(stopped.pictures)
    report = json.loads((tmp_path / "set" / "dataset.json").read_text())
    assert not report["complete"]
    assert len(report["pictures"]) == done
    assert len(json.loads((tmp_path / "set" / "transforms_train.json").read_text())["frames"]) == done
    again = _make(scene, tmp_path / "set")
    assert not again.missing
    files = sorted(path.relative_to(tmp_path / "set") for path in (tmp_path / "set").rglob("*") if path.is_file())
    assert files == sorted(p.relative_to(tmp_path / "whole") for p in (tmp_path / "whole").rglob("*") if p.is_file())
    for path in files:
        if path.name != "README.md":  # it names its folder
            assert (tmp_path / "set" / path).read_bytes() == (tmp_path / "whole" / path).read_bytes()


def test_size_and_noise_are_predicted(tmp_path: Path) -> None:
    scene = _scene(tmp_path)
    olat = OlatSet(scene, tmp_path / "set", SMALL, [_sky(tmp_path)])
    cost = olat.predict()
    assert (cost.pictures, cost.finished) == (6, 0)
    assert not (tmp_path / "set").exists()
    _make(scene, tmp_path / "set")
    found = json.loads((tmp_path / "set" / "dataset.json").read_text())["pictures"]
    noise = np.mean([each["relative_noise"] for name, each in found.items() if not name.startswith("held_out_skies")])
    assert cost.noise == pytest.approx(noise, rel=0.4)
    written = sum(path.stat().st_size for kind in ("exr", "png") for path in (tmp_path / "set").rglob(f"*.{kind}"))
    assert cost.bytes == pytest.approx(written, rel=0.3)
    assert OlatSet(scene, tmp_path / "set", SMALL, [_sky(tmp_path)]).predict().seconds == 0.0


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    scene = _scene(tmp_path)
    _make(scene, tmp_path / "set")
    with pytest.raises(FormatError, match="holds a test set of spp 8, not 16"):
        OlatSet(scene, tmp_path / "set", OlatSettings(2, 2, 1, 1, 20, 14, 16), [_sky(tmp_path)])
    (tmp_path / "bean.toml").write_text((tmp_path / "bean.toml").read_text().replace("0.9", "0.8"))
    with pytest.raises(FormatError, match="holds a test set of another scene"):
        OlatSet(read_scene(tmp_path / "bean.toml"), tmp_path / "set", SMALL, [_sky(tmp_path)])
    (tmp_path / "set" / "dataset.json").unlink()
    with pytest.raises(StorageError, match="expected a new or empty folder"):
        OlatSet(scene, tmp_path / "set", SMALL, [_sky(tmp_path)])


def test_a_black_sky_is_refused(tmp_path: Path) -> None:
    write_image(tmp_path / "night.exr", np.zeros((4, 8, 3), np.float32))
    with pytest.raises(LightError, match=r"night\.exr: is black"):
        held_out_skies([tmp_path / "night.exr"], "y")


def test_the_axes_of_the_files_are_those_of_skies_with_z_up() -> None:
    """A sky file is the same picture in both coordinates, whichever axis is up in the scene."""
    from prt_bake.lights.environment import lookup

    sky = np.random.default_rng(1).random((8, 16, 3)).astype(np.float32)
    towards = np.random.default_rng(2).normal(size=(64, 3))
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    for up in ("y", "z"):
        turned = Coordinates.of(ball(1), up).directions(towards)
        assert np.allclose(lookup(sky, towards, up), lookup(sky, turned, "z"))
