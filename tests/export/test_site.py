"""The folder that a browser shows: its files, its lights, what it refuses, and that it is written at once."""

import dataclasses
import json
import os
import re
import struct
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from formats.asset import read_asset, write_asset
from formats.errors import FormatError, LightError, QueryError, StorageError
from formats.image import read_image, write_image
from prt_bake.export import site
from prt_bake.export.site import export_site
from prt_bake.lights.environment import project, read_environment
from prt_bake.lights.lighting import read_lighting
from prt_bake.shading.asset_light import light_for
from prt_bake.shipped.examples import example
from tests import ROOT
from tests.export.assets import ball, smooth_asset

OWN = {"index.html", "view.js", "vendor", "site.json"}


def described(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "site.json").read_text())
    return found


def write_glb(path: Path, extras: dict[str, Any] | None) -> Path:
    text = json.dumps({"asset": {"version": "2.0"}, "meshes": [{"extras": {"prtbake": extras}} if extras else {}]})
    text += " " * (-len(text) % 4)
    head = struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text), len(text), b"JSON")
    path.write_bytes(head + text.encode())
    return path


def test_the_folder_has_the_page_the_asset_and_the_shipped_sky(page: Path, folder: Path, tmp_path: Path) -> None:
    target = tmp_path / "a folder" / "site"
    size = export_site(folder / "asset.h5", target)
    assert {path.name for path in target.iterdir()} == OWN | {"asset.h5", "sky.hdr"}
    assert (target / "vendor/three/three.module.js").read_text() == "vendor/three/three.module.js"
    assert (target / "asset.h5").read_bytes() == (folder / "asset.h5").read_bytes()
    assert np.array_equal(read_environment(target / "sky.hdr"), read_environment(example("sky.hdr")))
    written = described(target)
    assert written["objects"] == [{"name": "asset", "file": "asset.h5"}]
    assert written["lights"] == [{"name": "sky.hdr", "file": "sky.hdr"}]
    assert size == sum(path.stat().st_size for path in target.rglob("*") if path.is_file())
    assert [path.name for path in target.parent.iterdir()] == ["site"]


def test_assets_of_make_are_named_by_their_folders(page: Path, folder: Path, tmp_path: Path) -> None:
    assets = [tmp_path / name / "asset.h5" for name in ("jade", "white jade")]
    for asset in assets:
        asset.parent.mkdir()
        asset.write_bytes((folder / "asset.h5").read_bytes())
    export_site(assets, tmp_path / "site", say=lambda _: None)
    assert [each["name"] for each in described(tmp_path / "site")["objects"]] == ["jade/asset", "white jade/asset"]


def test_files_of_one_name_get_names_of_their_own(page: Path, folder: Path, tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    other = tmp_path / "other" / "ASSET.h5"
    other.write_bytes((folder / "asset.h5").read_bytes())
    lights = [folder / "sky.exr", folder / "sky.hdr", "sun:0,1,0"]
    export_site([other, folder / "asset.h5"], tmp_path / "site", lights, say=lambda _: None)
    written = described(tmp_path / "site")
    assert [each["file"] for each in written["objects"]] == ["ASSET.h5", "asset_2.h5"]
    assert [each["file"] for each in written["lights"]] == ["sky.hdr", "sky_2.hdr", "sun_0_1_0.hdr"]
    assert [each["name"] for each in written["lights"]] == ["sky.exr", "sky.hdr", "sun:0,1,0"]


def test_names_suit_every_web_server(page: Path, folder: Path, tmp_path: Path) -> None:
    odd = tmp_path / ".gläserne Kuh #1?.h5"
    odd.write_bytes((folder / "asset.h5").read_bytes())
    export_site(odd, tmp_path / "site")
    (entry,) = described(tmp_path / "site")["objects"]
    assert re.fullmatch(r"[A-Za-z0-9_-]+\.h5", entry["file"])
    assert entry["name"] == odd.stem
    assert (tmp_path / "site" / entry["file"]).is_file()


SKY = '[[sky]]\nfile = "sky.exr"\nrotate = 30\ntint = [0.5, 1, 2]\n'
TOML = {
    "sky.toml": SKY,
    "sky and sun.toml": f"[[directional]]\ndirection = [1, 2, -0.5]\nirradiance = [3, 2, 1]\n{SKY}",
}


@pytest.mark.parametrize(
    "light",
    [
        "sun:1,2,-0.5:3,2,1",
        "sun:0,1,0",
        "sun:0,0,-1:1,1,1:40",
        "sun:-1,-0.001,0:5,1,0:0.53",
        "sphere:3,4,2:0.5:40,30,20",
        *TOML,
    ],
)
def test_every_light_is_a_picture_of_the_same_harmonics(page: Path, folder: Path, tmp_path: Path, light: str) -> None:
    """RGBE rounds the radiance of a disc by up to 0.4 %; the discs of narrow suns are up to 2 degrees wide."""
    if light in TOML:
        sky = np.random.default_rng(2).random((32, 64, 3)).astype(np.float32)
        write_image(tmp_path / "sky.exr", sky)
        (tmp_path / light).write_text(TOML[light])
        light = str(tmp_path / light)
    said: list[str] = []
    export_site(folder / "asset.h5", tmp_path / "site", light, say=said.append)
    (entry,) = described(tmp_path / "site")["lights"]
    asset = read_asset(folder / "asset.h5")
    found = project(read_image(tmp_path / "site" / entry["file"]), up=asset.up)
    lighting = read_lighting(light, asset.up, mesh=asset.mesh, say=lambda _: None)
    expected = light_for(asset, lighting).whole
    assert np.abs(found - expected).max() <= 5e-3 * np.abs(expected).max()
    assert any("suns look softer" in sentence for sentence in said) == bool(lighting.suns)


def test_a_large_sky_becomes_smaller_and_keeps_its_light(page: Path, folder: Path, tmp_path: Path) -> None:
    sky = np.random.default_rng(3).random((1040, 2080, 3)).astype(np.float32)
    sky[100, 1000] = 50000.0
    write_image(tmp_path / "large.hdr", sky)
    export_site(folder / "asset.h5", tmp_path / "site", tmp_path / "large.hdr")
    small = read_image(tmp_path / "site" / "large.hdr")
    assert small.shape == (1024, 2048, 3)
    expected = project(sky)
    assert np.abs(project(small) - expected).max() <= 5e-3 * np.abs(expected).max()


def test_a_glb_is_shown_if_it_has_coefficients(page: Path, tmp_path: Path) -> None:
    shown = write_glb(tmp_path / "one light.glb", {"version": "1.0", "quantity": "radiance", "up": "y"})
    said: list[str] = []
    export_site(shown, tmp_path / "site", "sun:0,1,0", say=said.append)
    assert described(tmp_path / "site")["objects"] == [{"name": "one light", "file": "one_light.glb"}]
    assert described(tmp_path / "site")["lights"] == []
    assert said == ["the page shows the light that the asset was made for, and no other"]
    with pytest.raises(FormatError, match=r"plain\.glb: has no coefficients .* prtbake export"):
        export_site(write_glb(tmp_path / "plain.glb", None), tmp_path / "other")
    (tmp_path / "text.glb").write_text("solid")
    with pytest.raises(FormatError, match="has no coefficients"):
        export_site(tmp_path / "text.glb", tmp_path / "other")
    with pytest.raises(FormatError, match=r"newer\.glb: has version 2\.0 of the layout; this program reads 1\.x"):
        export_site(write_glb(tmp_path / "newer.glb", {"version": "2.0"}), tmp_path / "other")
    os.truncate(shown, shown.stat().st_size - 1)
    with pytest.raises(FormatError, match=r"one light\.glb: is truncated: has \d+ bytes of \d+"):
        export_site(shown, tmp_path / "other")


def test_errors_leave_no_folder(page: Path, folder: Path, tmp_path: Path) -> None:
    target = tmp_path / "site"
    for assets, lights, kind, message in (
        ([], (), QueryError, "give at least one"),
        ([tmp_path / "none.h5"], (), StorageError, "no such file"),
        ([folder / "sphere.ply"], (), FormatError, r"expected an asset \(\.h5\)"),
        ([folder / "asset.h5"], ("sun:0,0,0",), LightError, "direction"),
    ):
        with pytest.raises(kind, match=message):
            export_site(assets, target, lights)
    assert not target.exists()


def test_without_packages_one_sentence_says_what_to_run(page: Path, folder: Path, tmp_path: Path) -> None:
    (page / "vendor" / "VERSIONS").unlink()
    with pytest.raises(StorageError, match="run `make site`"):
        export_site(folder / "asset.h5", tmp_path / "site")


def test_only_an_earlier_export_is_replaced(page: Path, folder: Path, tmp_path: Path) -> None:
    asset, target = folder / "asset.h5", tmp_path / "site"
    target.mkdir()
    export_site(asset, target, "sun:0,1,0", say=lambda _: None)  # an empty folder is taken
    with pytest.raises(StorageError, match="add --force"):
        export_site(asset, target)
    export_site(asset, target, force=True)
    assert {path.name for path in target.iterdir()} == OWN | {"asset.h5", "sky.hdr"}
    (target / "CNAME").write_text("example.org")
    with pytest.raises(StorageError, match="has CNAME, which `prtbake export` did not write"):
        export_site(asset, target, force=True)
    other = tmp_path / "other"
    other.mkdir()
    (other / "site.json").write_text("[]")
    for force in (False, True):
        with pytest.raises(StorageError, match="is not a folder that `prtbake export` wrote"):
            export_site(asset, other, force=force)
    with pytest.raises(StorageError, match="expected a folder, found a file"):
        export_site(asset, asset)


def test_a_full_disk_leaves_the_earlier_folder(
    page: Path, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "site"
    export_site(folder / "asset.h5", target)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(site.shutil, "copyfile", full)
    with pytest.raises(StorageError, match="the disk is full"):
        export_site(folder / "asset.h5", target, force=True)
    assert {path.name for path in target.iterdir()} == OWN | {"asset.h5", "sky.hdr"}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["page", "site"]


def test_ctrl_c_leaves_the_earlier_folder(
    page: Path, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "site"
    export_site(folder / "asset.h5", target)
    rename = Path.rename

    def stopped(path: Path, to: Path) -> Path:
        if path.name == "new":
            raise KeyboardInterrupt
        return rename(path, to)

    monkeypatch.setattr(Path, "rename", stopped)
    with pytest.raises(KeyboardInterrupt):
        export_site(folder / "asset.h5", target, force=True)
    assert {path.name for path in target.iterdir()} == OWN | {"asset.h5", "sky.hdr"}


def test_a_link_to_a_folder_stays_one(page: Path, folder: Path, tmp_path: Path) -> None:
    (tmp_path / "served").mkdir()
    link = tmp_path / "link"
    link.symlink_to("served", target_is_directory=True)
    for force in (False, True):
        export_site(folder / "asset.h5", link, force=force)
        assert link.is_symlink()
        assert {path.name for path in (tmp_path / "served").iterdir()} == OWN | {"asset.h5", "sky.hdr"}


def test_the_current_folder_is_not_replaced(
    page: Path, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    with pytest.raises(StorageError, match=r"is the current folder, .* name a folder in it"):
        export_site(folder / "asset.h5", ".")


def test_what_file_managers_leave_does_not_keep_a_folder(page: Path, folder: Path, tmp_path: Path) -> None:
    export_site(folder / "asset.h5", tmp_path / "site")
    (tmp_path / "site" / ".DS_Store").write_text("")
    export_site(folder / "asset.h5", tmp_path / "site", force=True)
    assert not (tmp_path / "site" / ".DS_Store").exists()


def test_an_asset_that_no_browser_can_hold_is_refused(
    page: Path, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    vertices, bins, terms, channels = read_asset(folder / "asset.h5", load=False).coefficients.shape
    texels = vertices * (bins + 1) * -(-terms * channels // 4)
    monkeypatch.setattr(site, "_MOST_TEXELS", texels - 1)
    with pytest.raises(QueryError, match=r"on the GPU; show a smaller form: prtbake compress .*compact\.h5"):
        export_site(folder / "asset.h5", tmp_path / "site")
    monkeypatch.setattr(site, "_MOST_TEXELS", texels)
    export_site(folder / "asset.h5", tmp_path / "site")


def test_a_light_near_objects_at_different_places_is_refused(page: Path, tmp_path: Path) -> None:
    for name, offset in (("a", 0.0), ("b", 20.0)):
        mesh = ball(1)
        moved = dataclasses.replace(mesh, positions=mesh.positions + np.array([offset, 0.0, 0.0]))
        write_asset(smooth_asset(moved), tmp_path / f"{name}.h5")
    both = [tmp_path / "a.h5", tmp_path / "b.h5"]
    with pytest.raises(QueryError, match=r"is near the objects, which see it in different directions"):
        export_site(both, tmp_path / "site", "sphere:10,0,0:1", say=lambda _: None)
    export_site(both, tmp_path / "far", "sun:1,0,0", say=lambda _: None)
    export_site(both[:1], tmp_path / "one", "sphere:10,0,0:1", say=lambda _: None)


def test_a_large_asset_is_told_how_to_become_small(
    page: Path, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(site, "_LARGE", 1000.0)
    said: list[str] = []
    export_site(folder / "asset.h5", tmp_path / "site", say=said.append)
    assert sum("prtbake compress" in sentence for sentence in said) == 1


def test_the_wheel_and_the_export_carry_the_same_files() -> None:
    """The real page, and its packages where `make site` has been run."""
    data = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    packed = {path for pattern in data["prt_bake.export"] for path in (ROOT / "prt_bake/export").glob(pattern)}
    package = json.loads((site.PAGE / "package.json").read_text())
    if (site.PAGE / "vendor").exists():
        vendored = {path for path in packed if path.is_file() and site.PAGE / "vendor" in path.parents}
        names = {path.relative_to(site.PAGE / "vendor").as_posix() for path in vendored}
        assert names == {*package["vendor"], "VERSIONS"}, "`make site` brings the packages that package.json names now"
        assert {path for path in packed if path.is_file()} == {path for _, path in site._page_files()}
    assert {"three/LICENSE", "h5wasm/LICENSE.txt"} <= package["vendor"].keys()
    lock = json.loads((site.PAGE / "package-lock.json").read_text())["packages"]
    for name, version in package["dependencies"].items():
        assert re.fullmatch(r"\d+\.\d+\.\d+", version)
        assert lock[f"node_modules/{name}"]["version"] == version
        assert lock[f"node_modules/{name}"]["integrity"].startswith("sha512-")
