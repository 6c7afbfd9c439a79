"""What a person does on the page: orbit, turn the light, drop files; and what the page says of bad files."""

import json
import os
import re
import struct
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import prt_bake as prt
from formats.asset import read_asset, write_asset
from prt_bake.baking.compress import compress
from prt_bake.export.gltf import export_gltf
from prt_bake.shipped.examples import example
from tests.engines.conftest import RunNode
from tests.engines.pages import BACKENDS, drive, make_site, states
from tests.export.assets import smooth_asset

pytestmark = pytest.mark.usefixtures("chromium")

WEBGL = BACKENDS["webgl"]
HDF5_ERRORS = ["HDF5", "#0", "major:", "minor:", "H5"]
READS = "and this page reads 1.x; export a newer page."
INCOMPLETE = "Files of this page are missing on the server; export it again, with its folder vendor."


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with asset.h5, asset.glb and sky.hdr."""
    folder = tmp_path_factory.mktemp("files")
    asset = smooth_asset()
    write_asset(asset, folder / "asset.h5")
    export_gltf(asset, folder / "asset.glb", 3)
    (folder / "sky.hdr").write_bytes(example("sky.hdr").read_bytes())
    return folder


@pytest.fixture
def site(files: Path, tmp_path: Path) -> Path:
    return make_site(tmp_path / "site", [files / "asset.h5", files / "asset.glb"], [files / "sky.hdr"])


def test_the_error_counts_compression(run_node: RunNode, tmp_path: Path) -> None:
    asset = smooth_asset()
    asset.provenance["estimated_relative_rmse"] = {"total": 0.013, "percentile_95_over_vertices": 0.02}
    write_asset(compress(asset, 0.03), tmp_path / "compact.h5")
    bake = read_asset(tmp_path / "compact.h5").error.bake
    assert bake is not None
    assert bake > 0.02
    (state,) = states(run_node, make_site(tmp_path / "site", [tmp_path / "compact.h5"], []))
    found = re.search(r"bake ([\d.]+) %", state["error"])
    assert found
    assert float(found[1]) == pytest.approx(100 * bake, abs=0.06)


def test_unknown_errors_are_called_so_and_path_traced_assets_have_no_network(run_node: RunNode, tmp_path: Path) -> None:
    asset = smooth_asset()
    asset.provenance["estimated_relative_rmse"] = {"total": None}
    write_asset(compress(asset, 0.005), tmp_path / "unknown.h5")
    asset.provenance.update(walks=100, estimated_relative_rmse={"total": 0.013})
    write_asset(asset, tmp_path / "traced.h5")
    site = make_site(tmp_path / "site", [tmp_path / "unknown.h5", tmp_path / "traced.h5"])
    unknown, traced = states(run_node, site, ["click", "#next"])
    assert unknown["error"] == "Error: network unknown, bake unknown."
    assert traced["error"] == "Error: bake 1.3 %."


def test_next_object_and_dropped_files(run_node: RunNode, site: Path, files: Path, tmp_path: Path) -> None:
    write_asset(smooth_asset(degree=1), tmp_path / "dropped.h5")
    prt.write_image(tmp_path / "evening.hdr", np.ones((8, 16, 3), np.float32))
    first, second, dropped, lit = states(
        run_node,
        site,
        ["click", "#next"],
        ["drop", str(tmp_path / "dropped.h5")],
        ["drop", str(tmp_path / "evening.hdr")],
    )
    assert first["name"] == second["name"] == "asset"
    assert first["error"] != second["error"]
    assert "this form adds" in second["error"]
    assert first["leftOut"] == "Light is 9 coefficients, so narrow light looks soft."
    assert second["leftOut"].startswith("Not shown: suns shaded apart. ")
    assert dropped["name"] == "dropped.h5"
    assert "4 coefficients" in dropped["leftOut"]
    assert lit["light"] == "evening.hdr"
    assert all(state["message"] == "" for state in (first, second, dropped, lit))


def other_version(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file.attrs["format_version"] = "2.0"


def other_format(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file.attrs["format"] = "another"


def cut(path: Path) -> None:
    os.truncate(path, path.stat().st_size * 2 // 3)


def cut_in_header(path: Path) -> None:
    os.truncate(path, path.read_bytes().index(b"-Y") + 4)


def rewritten(path: Path, change: Any) -> None:
    """Change the JSON of a GLB."""
    content = path.read_bytes()
    size = struct.unpack_from("<I", content, 12)[0]
    document = json.loads(content[20 : 20 + size])
    change(document)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    rest = content[20 + size :]
    path.write_bytes(struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON") + text + rest)


def without_extras(path: Path) -> None:
    rewritten(path, lambda document: document["meshes"][0].pop("extras"))


def without_attributes(path: Path) -> None:
    rewritten(path, lambda document: document["meshes"][0]["primitives"][0]["attributes"].pop("_PRT_2_1"))


def newer(path: Path) -> None:
    rewritten(path, lambda document: document["meshes"][0]["extras"]["prtbake"].update(version="2.0"))


def text(path: Path) -> None:
    path.write_text("a letter")


def emptied(path: Path) -> None:
    path.write_bytes(b"")


def xyz(path: Path) -> None:
    path.write_bytes(path.read_bytes().replace(b"32-bit_rle_rgbe", b"32-bit_rle_xyze"))


def cut_picture(path: Path) -> None:
    prt.write_image(path, np.random.default_rng(0).random((64, 128, 3)).astype(np.float32))
    cut(path)


def not_finite(path: Path) -> None:
    pixels = np.ones((8, 16, 3), np.float32)
    pixels[2, 3] = np.nan
    prt.write_image(path, pixels)


@pytest.mark.parametrize(
    ("name", "damage", "says"),
    [
        ("asset.h5", cut, "asset.h5 is truncated or damaged; copy it again."),
        (
            "asset.h5",
            other_version,
            f"asset.h5 has version 2.0 of the format, {READS}",
        ),
        ("asset.h5", other_format, "asset.h5 is an HDF5 file, but no asset of prtbake."),
        ("asset.glb", cut, "asset.glb is truncated or damaged; copy it again."),
        ("asset.glb", newer, f"asset.glb has version 2.0 of the layout, {READS}"),
        (
            "asset.glb",
            without_extras,
            "asset.glb has no data of prtbake; if another program wrote it, export again.",
        ),
        ("asset.glb", without_attributes, "asset.glb has lost _PRT_2_1 in another program; export it again."),
        ("sky.hdr", cut_in_header, "sky.hdr is truncated in its header; copy it again."),
        ("sky.hdr", cut, r"sky.hdr is truncated in row \d+ of 256; copy it again."),
        ("sky.hdr", xyz, "sky.hdr is stored in an unusual order or in XYZ; save it again as RGBE."),
        ("sky.exr", cut_picture, "sky.exr is truncated or damaged; copy it again."),
        (
            "sky.exr",
            not_finite,
            "sky.exr has pixels that are not finite; repair it, or export the page with it and --mend.",
        ),
        ("asset.h5", emptied, "asset.h5 is empty; copy it again."),
        ("asset.h5", text, "asset.h5 is neither an asset (.h5, .glb) nor a sky (.hdr, .exr)."),
    ],
)
def test_what_the_page_says_of_a_bad_file(
    name: str, damage: Any, says: str, run_node: RunNode, site: Path, files: Path, tmp_path: Path
) -> None:
    """The object stays, and a file that is good is shown after it."""
    bad = tmp_path / name
    bad.write_bytes((files / name).read_bytes() if (files / name).exists() else b"")
    damage(bad)
    first, dropped, after = states(
        run_node,
        site,
        ["drop", str(bad)],
        ["drop", str(files / "asset.glb")],
        allowed=HDF5_ERRORS,
    )
    assert re.fullmatch(re.escape(says).replace(r"\\d\+", r"\d+"), dropped["message"])
    assert dropped["name"] == first["name"] == "asset"
    assert (after["message"], after["name"]) == ("", "asset.glb")


def moved(path: Path) -> Path:
    """The vertices of a GLB in another order, as other programs leave them."""
    content = bytearray(path.read_bytes())
    size = struct.unpack_from("<I", content, 12)[0]
    document = json.loads(content[20 : 20 + size])
    start = 28 + size
    primitive = document["meshes"][0]["primitives"][0]
    count = document["accessors"][primitive["attributes"]["POSITION"]]["count"]
    order = np.random.default_rng(0).permutation(count)
    for accessor in primitive["attributes"].values():
        described = document["accessors"][accessor]
        view = document["bufferViews"][described["bufferView"]]
        at = start + view.get("byteOffset", 0) + described.get("byteOffset", 0)
        width = {"VEC2": 2, "VEC3": 3}[described["type"]]
        numbers = np.frombuffer(content, np.float32, count * width, at).reshape(count, width)
        content[at : at + numbers.nbytes] = numbers[order].tobytes()
    described = document["accessors"][primitive["indices"]]
    kind = {5123: np.uint16, 5125: np.uint32}[described["componentType"]]
    at = start + document["bufferViews"][described["bufferView"]].get("byteOffset", 0)
    corners = np.frombuffer(content, kind, described["count"], at)
    content[at : at + corners.nbytes] = np.argsort(order)[corners].astype(kind).tobytes()
    path.write_bytes(content)
    return path


def test_a_reordered_glb_meets_its_self_test_and_a_changed_one_does_not(
    run_node: RunNode, files: Path, tmp_path: Path
) -> None:
    for name in ("reordered.glb", "merged.glb"):
        (tmp_path / name).write_bytes((files / "asset.glb").read_bytes())
    moved(tmp_path / "reordered.glb")
    rewritten(tmp_path / "merged.glb", swap_attributes)
    site = make_site(tmp_path / "site", [tmp_path / "reordered.glb", tmp_path / "merged.glb"])
    good, bad = states(run_node, site, ["click", "#next"])
    assert good["check"] == "meets its self-test"
    assert bad["check"].startswith("fails its self-test: ")


def swap_attributes(document: dict[str, Any]) -> None:
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    attributes["_PRT_1_0"], attributes["_PRT_2_0"] = attributes["_PRT_2_0"], attributes["_PRT_1_0"]


def test_what_an_asset_leaves_out_is_named(run_node: RunNode, files: Path, tmp_path: Path) -> None:
    for name in ("one_eye.h5", "partial.h5"):
        (tmp_path / name).write_bytes((files / "asset.h5").read_bytes())
    with h5py.File(tmp_path / "one_eye.h5", "r+") as file:
        file.attrs["left_out"] = '[{"item": "other views"}]'
    with h5py.File(tmp_path / "partial.h5", "r+") as file:
        file.attrs["complete"] = np.uint8(0)
    site = make_site(tmp_path / "site", [tmp_path / "one_eye.h5", tmp_path / "partial.h5"])
    one_eye, partial = states(run_node, site, ["click", "#next"])
    assert one_eye["leftOut"].startswith("Not shown: other views. ")
    assert "vertices not baked yet, which are black." in partial["leftOut"]


def test_a_sky_for_an_object_of_one_light_waits_for_the_next(run_node: RunNode, site: Path, tmp_path: Path) -> None:
    export_gltf(smooth_asset(), tmp_path / "one_light.glb", 3, light=np.ones((9, 3)))
    prt.write_image(tmp_path / "evening.hdr", np.ones((8, 16, 3), np.float32))
    _, waiting, lit = states(
        run_node, site, ["drop", str(tmp_path / "one_light.glb"), str(tmp_path / "evening.hdr")], ["click", "#next"]
    )
    assert waiting["message"] == "evening.hdr lights the next object; the light of this one cannot change."
    assert (lit["message"], lit["light"]) == ("", "evening.hdr")


@pytest.mark.parametrize("content", ["{", "null"])
def test_a_damaged_list_of_objects(content: str, run_node: RunNode, site: Path, files: Path) -> None:
    (site / "site.json").write_text(content)
    damaged, dropped = states(run_node, site, ["drop", str(files / "asset.glb")])
    assert damaged["message"] == "site.json is damaged; export the page again."
    assert (dropped["message"], dropped["name"], dropped["light"]) == ("", "asset.glb", "sun")


def test_of_two_objects_opened_at_once_the_last_one_stays(run_node: RunNode, site: Path, files: Path) -> None:
    """The first one arrives later."""
    (site / "asset.glb").write_bytes((files / "asset.glb").read_bytes())
    slow = "const now = window.fetch; window.fetch = async (name) => {"
    slow += ' if (name === "asset.glb") await new Promise((done) => setTimeout(done, 3000)); return now(name); };'
    both = [["press", "#next", 2], ["wait", 8000], ["rest"], ["state"]]
    first, last = (
        found for found in drive(run_node, site, [["ready"], ["state"], *both], before=slow, **WEBGL) if found
    )
    assert (last["message"], last["error"]) == ("", first["error"])


@pytest.mark.parametrize("number", ["-1", "three"])
def test_an_object_that_the_address_does_not_have(number: str, run_node: RunNode, site: Path) -> None:
    state = states(run_node, site, query=f"backend=webgl&object={number}")[0]
    assert (state["message"], state["name"]) == ("", "asset")


NO_WEBGL = "HTMLCanvasElement.prototype.getContext = () => null;"
NO_GPU = 'Object.defineProperty(Navigator.prototype, "gpu", { get: () => undefined });'


def test_a_browser_without_graphics_and_a_lost_one(run_node: RunNode, site: Path) -> None:
    for before in (NO_WEBGL + NO_GPU, NO_WEBGL):  # browsers have navigator.gpu without a device that it could give
        without = states(run_node, site, before=before)[0]
        assert without["message"].startswith("This browser has neither WebGL 2 nor WebGPU")
    _, lost = states(run_node, site, ["lose"], allowed=["CONTEXT_LOST", "WebGL"])
    assert lost["message"] == "The graphics device was lost; reload the page."


@pytest.mark.parametrize(
    ("missing", "says"),
    [
        ("site.json", "site.json is missing on the server; export the page again."),
        ("asset.h5", "asset.h5 is missing on the server; export the page again."),
        ("sky.hdr", "sky.hdr is missing on the server; export the page again."),
        (
            "vendor/three/three.webgpu.js",
            "Files of this page are missing on the server; export it again, with its folder vendor.",
        ),
        ("viewer.js", INCOMPLETE),
    ],
)
def test_missing_files(missing: str, says: str, run_node: RunNode, site: Path) -> None:
    (site / missing).unlink()
    steps: list[Any] = [["wait", 3000], ["ready"], ["state"]]
    assert drive(run_node, site, steps, allowed=["404", "ERR_ABORTED"], **WEBGL)[-1]["message"] == says


def test_a_damaged_sky_of_the_page_is_named_and_the_sun_shines_instead(run_node: RunNode, site: Path) -> None:
    cut(site / "sky.hdr")
    damaged, again = states(run_node, site, ["click", "#next-light"])
    assert damaged["message"].startswith("sky.hdr is truncated in row ")
    assert damaged["light"] == "sun"
    assert (again["light"], again["lit"]) == ("sun", True)
    assert again["message"].startswith("sky.hdr is truncated in row ")


def test_a_page_that_was_opened_as_a_file_says_how_to_serve_it(run_node: RunNode, site: Path) -> None:
    job = {"address": (site / "index.html").as_uri(), "allowed": [".*"]}
    state = drive(run_node, site, [["wait", 500], ["state"]], **job)[-1]
    assert state["message"].startswith("Browsers show this page from a web server only: run “python -m http.server”")


def test_a_sky_of_8k(run_node: RunNode, site: Path, tmp_path: Path) -> None:
    """A phone lights the object by it: the page reads it row by row."""
    rows = np.tile(np.array([128, 64, 32, 128], np.uint8), 8192 * 4096).tobytes()
    (tmp_path / "8k.hdr").write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 4096 +X 8192\n" + rows)
    (site / "8k.hdr").write_bytes((tmp_path / "8k.hdr").read_bytes())
    (site / "site.json").write_text(
        json.dumps({"objects": [{"name": "asset", "file": "asset.h5"}], "lights": [{"name": "8k", "file": "8k.hdr"}]})
    )
    steps: list[Any] = [["ready"], ["state"], ["coefficients"]]
    _, state, light = drive(run_node, site, steps, touch=True, **(WEBGL | {"width": 390, "height": 844}))
    assert state["message"] == ""
    assert np.allclose(light[:3], np.sqrt(4.0 * np.pi) * np.array([0.5, 0.25, 0.125]), rtol=1e-6)
    assert np.allclose(light[3:], 0.0, atol=1e-6)
