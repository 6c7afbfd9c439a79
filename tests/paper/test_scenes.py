"""The scenes of the tables: cameras, bake settings, skies and stand-ins."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from formats.errors import QueryError, SceneError, StorageError
from formats.image import read_image
from formats.mesh import read_mesh
from prt_bake.geometry import camera
from prt_bake.geometry.camera import Visibility
from prt_bake.lights import environment
from prt_bake.paper.harmonics import subdivided
from prt_bake.paper.report import sky_files
from prt_bake.paper.scenes import (
    LEAST_SHARE,
    NAMES,
    SCENES,
    SKIES,
    framing_camera,
    is_stand_in,
    object_share,
    open_scene,
    scenes_folder,
    select_scenes,
)
from prt_bake.paper.settings import ReportSettings
from tests import ROOT

FOLDER = ROOT / "scenes"


def shrink(sky: np.ndarray, width: int, height: int) -> np.ndarray:
    specification = importlib.util.spec_from_file_location("shrink", FOLDER / "shrink.py")
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    sys.modules["shrink"] = module
    specification.loader.exec_module(module)
    return module.shrink(sky, width, height)


@pytest.mark.parametrize("paper", SCENES, ids=NAMES)
def test_the_object_fills_enough_of_the_picture(paper) -> None:
    scene = open_scene(paper, FOLDER)
    view, fitted = (
        framing_camera(scene.mesh, 512, scene.up),
        camera.fit(scene.mesh, 512, 512, up=scene.up, view="three-quarter-back"),
    )
    share = object_share(Visibility(scene.mesh), view)
    assert share >= LEAST_SHARE
    np.testing.assert_array_equal(view.eye, fitted.eye)
    assert view.fov <= fitted.fov
    assert share <= 0.43 or view.fov == fitted.fov
    assert (view.width, view.height) == (512, 512)


def test_stand_ins_replace_missing_scans(tmp_path: Path) -> None:
    dragon = select_scenes(["dragon"])[0]
    for name in dragon.files:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes((FOLDER / name).read_bytes())
    mesh = (FOLDER / "dragon/serpent.obj").read_bytes()
    (tmp_path / "dragon/serpent.obj").write_bytes(mesh)
    scene = open_scene(dragon, tmp_path)
    assert is_stand_in(dragon, scene)
    from formats.mesh import write_mesh

    write_mesh(read_mesh(tmp_path / "dragon/serpent.obj"), tmp_path / "dragon/stanford_dragon.ply")
    scene = open_scene(dragon, tmp_path)
    assert scene.path.name == "dragon.toml"
    assert not is_stand_in(dragon, scene)
    with pytest.raises(SceneError, match=r"lucy/figure\.toml: not found.*--scenes"):
        open_scene(select_scenes(["lucy"])[0], tmp_path)


def test_scenes_are_selected_in_the_papers_order() -> None:
    assert [scene.name for scene in select_scenes(["lucy", "grape"])] == ["grape", "lucy"]
    assert select_scenes([]) == SCENES
    with pytest.raises(QueryError, match="'teapot' is not a scene of the paper; expected grape, dragon"):
        select_scenes(["grape", "teapot"])


def test_skies_are_those_of_the_repository_or_files(tmp_path: Path) -> None:
    assert scenes_folder(None).samefile(FOLDER)
    assert list(sky_files([], FOLDER)) == ["outdoor", "indoor"]
    (tmp_path / "park.hdr").write_bytes((FOLDER / SKIES["outdoor"]).read_bytes())
    assert sky_files(["indoor", str(tmp_path / "park.hdr")], FOLDER) == {
        **{"indoor": FOLDER / "skies/indoor.hdr", "park": tmp_path / "park.hdr"},
    }
    with pytest.raises(StorageError, match=r"nowhere\.hdr: there is no such sky; expected outdoor, indoor"):
        sky_files(["nowhere.hdr"], FOLDER)


def test_two_skies_of_one_name_are_refused(tmp_path: Path) -> None:
    paths = [tmp_path / folder / "park.hdr" for folder in ("a", "b")]
    for path in paths:
        path.parent.mkdir()
        path.touch()
    with pytest.raises(QueryError, match="found two of park"):
        sky_files([str(path) for path in paths], tmp_path)


def test_quick_settings_limit_every_bake() -> None:
    quick = ReportSettings().quick()
    for paper in SCENES:
        bake = quick.bake(paper.bake)
        assert (bake.subdivisions, bake.rings, bake.sectors, bake.samples) == (0, 4, 8, 32)
        assert ReportSettings().bake(paper.bake) == paper.bake
    assert ReportSettings(reference_spp=None, reference_minutes=3.0).quick().reference_minutes == 3.0


def test_a_subdivided_mesh_is_the_same_surface() -> None:
    mesh = read_mesh(FOLDER / "paperweight/cube.obj")
    fine = subdivided(mesh, 2)
    assert len(fine.faces) == 16 * len(mesh.faces)
    assert fine.face_areas.sum() == pytest.approx(mesh.face_areas.sum(), rel=1e-12)
    np.testing.assert_allclose(fine.bounds, mesh.bounds)
    assert subdivided(mesh, 0) is mesh


def test_a_downsampled_sky_keeps_its_energy() -> None:
    sky = np.random.default_rng(1).lognormal(0.0, 2.0, (48, 96, 3))
    small = shrink(sky, 24, 12)
    rows = [np.cos(np.pi * np.arange(count + 1) / count) for count in (48, 12)]
    fine, coarse = ((edges[:-1] - edges[1:])[:, None, None] for edges in rows)
    blocks = (sky * fine).reshape(12, 4, 24, 4, 3).sum(axis=(1, 3))
    np.testing.assert_allclose(small * coarse * 4, blocks, rtol=1e-12)
    np.testing.assert_allclose(shrink(np.full((48, 96, 3), 2.5), 24, 12), 2.5)
    with pytest.raises(ValueError, match="not a multiple of 20x12"):
        shrink(sky, 20, 12)


@pytest.mark.parametrize("name", sorted(SKIES))
def test_the_repositorys_skies_are_small_and_sound(name: str) -> None:
    path = FOLDER / SKIES[name]
    assert path.stat().st_size < 150_000
    sky = read_image(path)
    assert sky.shape == (128, 256, 3)
    environment.check(sky, path)
    assert path.name in (FOLDER / "skies/LICENSES.md").read_text(encoding="utf-8")
