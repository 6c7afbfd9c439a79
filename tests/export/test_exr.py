import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

import prt_bake as prt
from formats.errors import QueryError
from prt_bake.export.engine_form import EngineForm, engine_form
from prt_bake.export.exr import LARGEST_SIDE, layout_of
from prt_bake.export.quantization import in_halves
from prt_bake.mathematics import sh
from tests.cli.command_line import Run
from tests.export.assets import smooth_asset
from tests.export.glb_reader import array, read_glb
from tests.formats.image.exr_reader import read_halves


def read(path: Path) -> tuple[np.ndarray, dict, dict[str, np.ndarray]]:
    """The texture, X.json and the attributes of X.mesh.glb."""
    content = path.with_suffix(".mesh.glb").read_bytes()
    length = int.from_bytes(content[12:16], "little")
    document, binary = json.loads(content[20 : 20 + length]), content[28 + length :]
    names = document["meshes"][0]["primitives"][0]["attributes"]
    attributes = {name: array(document, binary, index) for name, index in names.items()}
    return read_halves(path), json.loads(path.with_suffix(".json").read_text("utf-8")), attributes


def vertex_numbers(texture: np.ndarray, description: dict, texel: np.ndarray) -> np.ndarray:
    """A [n,R,K,3] of vertices by their TEXCOORD_1 [n,2], as a shader fetches them."""
    height, width, _ = texture.shape
    column, row = np.floor(texel * [width, height]).astype(int).T
    run = description["texture"]["texels_per_vertex"]
    shape = (description["view_degree"] + 1) ** 2, (description["light_degree"] + 1) ** 2, 3
    return texture[row[:, None], column[:, None] + np.arange(run)].reshape(len(texel), *shape)


def test_the_texture_holds_the_form_rounded_to_halves(tmp_path: Path) -> None:
    asset = smooth_asset()
    prt.export_exr(asset, tmp_path / "x.exr", degree=2)
    texture, description, attributes = read(tmp_path / "x.exr")
    form = engine_form(asset, 2).coefficients.astype(np.float16)
    found = vertex_numbers(texture, description, attributes["TEXCOORD_1"])
    assert np.array_equal(found.view(np.uint16), form.view(np.uint16))
    layout = description["texture"]
    assert texture.shape == (layout["height"], layout["width"], 3)
    assert layout["width"] == layout["vertices_per_row"] * layout["texels_per_vertex"]
    assert layout["texels_per_vertex"] == 81
    runs = texture.reshape(-1, 81, 3)
    assert np.array_equal(runs[: len(form)].reshape(form.shape), form)
    assert (runs[len(form) :] == 0).all()
    assert not {"attributes", "texels", "quantize"} & description.keys()


def test_the_selftest_is_of_the_halves(tmp_path: Path) -> None:
    prt.export_exr(smooth_asset(), tmp_path / "x.exr")
    texture, description, attributes = read(tmp_path / "x.exr")
    test = {name: np.array(values) for name, values in description["selftest"].items()}
    numbers = vertex_numbers(texture, description, attributes["TEXCOORD_1"][test["vertex"]]).astype(float)
    found = np.einsum("nr,nrkc,kc->nc", sh.evaluate(test["outgoing"], 3), numbers, test["light"])
    np.testing.assert_allclose(found, test["radiance"], rtol=1e-12)
    off = np.einsum("nr,nrkc,kc->nc", sh.evaluate(test["outgoing"], 3), np.roll(numbers, 1, 0), test["light"])
    assert not np.allclose(off, test["radiance"], rtol=1e-2)


def test_the_mesh_is_that_of_the_glb(tmp_path: Path) -> None:
    asset = smooth_asset()
    prt.export_gltf(asset, tmp_path / "x.glb")
    prt.export_exr(asset, tmp_path / "x.exr")
    _, description, attributes = read(tmp_path / "x.exr")
    glb = read_glb(tmp_path / "x.glb")
    assert set(attributes) == {"POSITION", "NORMAL", "TEXCOORD_0", "TEXCOORD_1", "COLOR_0"}
    for name in ("POSITION", "NORMAL", "COLOR_0"):
        assert np.array_equal(attributes[name], glb.attributes[name])
    assert description["light"] == glb.extras["light"]
    assert description["vertices"] == glb.extras["vertices"]


def test_one_light_is_folded_in(tmp_path: Path) -> None:
    asset = smooth_asset()
    light = sh.evaluate([0.6, 0.64, 0.48], 2)[:, None] * [3.0, 2.0, 1.0]
    prt.export_exr(asset, tmp_path / "x.exr", light=light, light_name="sun")
    texture, description, attributes = read(tmp_path / "x.exr")
    assert description["texture"]["texels_per_vertex"] == 16
    assert description["quantity"] == "radiance"
    form = engine_form(asset, 3, light).coefficients
    found = vertex_numbers(texture, description, attributes["TEXCOORD_1"])
    np.testing.assert_allclose(found, form, rtol=2**-11, atol=1e-7)


def test_an_asset_beyond_half_floats_is_refused(tmp_path: Path) -> None:
    asset = smooth_asset()
    bright = dataclasses.replace(asset, coefficients=1e5 * np.asarray(asset.coefficients))
    with pytest.raises(QueryError, match=r"a coefficient is .*e\+05, half floats end at 65,504; export it as X\.glb"):
        prt.export_exr(bright, tmp_path / "x.exr")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("value", [65520.0, -7e4, np.nan, np.inf])
def test_what_no_half_float_holds_is_refused(value: float) -> None:
    coefficients = np.zeros((2, 1, 1, 3), np.float32)
    coefficients[1, 0, 0, 2] = value
    with pytest.raises(QueryError, match="half floats end at 65,504"):
        in_halves(EngineForm(coefficients, 0, 0, "radiance"))


@pytest.mark.parametrize(("vertices", "run"), [(2930, 144), (1, 9), (5, 729), (100_000, 16), (1_800_000, 144)])
def test_the_texture_is_about_square(vertices: int, run: int) -> None:
    layout = layout_of(form_of(vertices, run))
    assert layout.width * layout.height >= vertices * run
    assert (layout.height - 1) * layout.vertices_per_row < vertices
    assert max(layout[:2]) <= LARGEST_SIDE
    assert layout.height <= 2 * layout.width or layout.vertices_per_row == vertices


def test_a_texture_that_no_gpu_takes_is_refused() -> None:
    with pytest.raises(QueryError, match=r"2,000,000 vertices of 144 texels need a texture of 16,992 × 16,950 texels"):
        layout_of(form_of(2_000_000, 144))


def form_of(vertices: int, run: int) -> EngineForm:
    """A form of that shape, without memory."""
    return EngineForm(np.broadcast_to(np.float32(0), (vertices, run, 1, 3)), 3, 2, "transfer")


def test_the_command(prtbake: Run, folder: Path, tmp_path: Path) -> None:
    outcome = prtbake("export", "asset.h5", "-o", tmp_path / "out.exr", "--degree", "1")
    assert outcome.code == 0
    assert "beside it: out.json, out.mesh.glb" in outcome.out
    texture, description, _ = read(tmp_path / "out.exr")
    assert texture.shape[1] == description["texture"]["width"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("-o", "out.exr", "--quantize", "int8"), "--quantize: has no effect on --to exr"),
        (("-o", "out.png", "--to", "exr"), "out.png: expected a name that ends in .exr; give -o out.exr"),
        (("-o", "out.exr", "--to", "glb"), "out.exr: expected a name that ends in .glb; give -o out.glb"),
    ],
)
def test_refusals_of_the_command(
    arguments: tuple[str, ...], message: str, prtbake: Run, folder: Path, tmp_path: Path
) -> None:
    outcome = prtbake("export", "asset.h5", *arguments)
    assert outcome.code != 0
    assert message in outcome.err
    assert not (folder / "out.exr").exists()
