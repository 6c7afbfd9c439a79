import dataclasses
from pathlib import Path

import numpy as np
import pytest

import prt_bake as prt
from formats.errors import QueryError, StorageError
from prt_bake.export import glb
from prt_bake.export.engine_form import engine_form
from prt_bake.mathematics import sh
from tests.export.assets import ball, smooth_asset, view_directions
from tests.export.glb_reader import Read, radiance, read_glb

SUN = np.repeat(sh.evaluate([0.6, 0.64, 0.48], 2)[:, None], 3, axis=1) * [3.0, 2.0, 1.0]


def export(path: Path, asset: prt.Asset | None = None, **options) -> Read:
    prt.export_gltf(asset or smooth_asset(), path / "x.glb", **options)
    return read_glb(path / "x.glb")


def passes_selftest(read: Read) -> bool:
    test = {name: np.array(values) for name, values in read.extras["selftest"].items()}
    found = radiance(read, test["vertex"], test["outgoing"], test["light"])
    return bool(np.abs(found - test["radiance"]).max() <= 1e-6 * np.abs(test["radiance"]).max())


@pytest.mark.parametrize("quantize", [None, "int8"])
def test_another_reader_finds_the_form_and_passes_the_selftest(tmp_path: Path, quantize: str | None) -> None:
    asset = smooth_asset()
    read = export(tmp_path, asset, quantize=quantize)
    tolerance = 0.0 if quantize is None else 0.0041
    form = engine_form(asset, 3).coefficients
    np.testing.assert_allclose(read.coefficients, form, atol=tolerance * np.abs(form).max(), rtol=0.0)
    assert passes_selftest(read)
    assert len(set(read.extras["selftest"]["vertex"])) == 4
    np.testing.assert_allclose(read.extras["check_values"], sh.evaluate(read.extras["check_directions"], 3), atol=1e-12)


@pytest.mark.parametrize("axis", [0, 1, 2, 3])
def test_a_reader_that_is_off_by_one_fails_the_selftest(tmp_path: Path, axis: int) -> None:
    read = export(tmp_path)
    assert not passes_selftest(read._replace(coefficients=np.roll(read.coefficients, 1, axis)))


@pytest.mark.parametrize("quantize", [None, "int8"])
def test_the_stated_error_is_the_one_that_another_reader_measures(tmp_path: Path, quantize: str | None) -> None:
    asset = smooth_asset()
    read = export(tmp_path, asset, degree=3, quantize=quantize)
    true = np.asarray(asset.coefficients, np.float64)
    found = np.zeros_like(true)
    for b, outgoing in enumerate(view_directions(asset.mesh).transpose(1, 0, 2)):
        for k, light in enumerate(np.eye(9)):
            found[:, b, k] = radiance(read, np.arange(len(true)), outgoing, np.repeat(light[:, None], 3, axis=1))
    measured = np.sqrt(((found - true) ** 2).sum() / (true**2).sum())
    assert read.extras["error"]["coefficients"] == pytest.approx(measured, rel=1e-4)


def test_the_selftest_is_of_baked_vertices_from_the_first_to_the_last(tmp_path: Path) -> None:
    asset = smooth_asset()
    valid = np.ones(len(asset.valid), np.bool_)
    valid[[0, 1, -1]] = False
    read = export(tmp_path, dataclasses.replace(asset, valid=valid))
    vertices = read.extras["selftest"]["vertex"]
    assert (min(vertices), max(vertices)) == (2, len(valid) - 2)
    assert all(valid[vertices])
    assert "3 vertices that were not baked, which are black" in read.extras["left_out"]
    assert "not baked" not in str(export(tmp_path, asset).extras["left_out"])


def test_a_file_beyond_the_format_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(glb, "_LARGEST", 10_000)
    with pytest.raises(StorageError, match=r"x\.glb: would have .* GB, and binary glTF ends at"):
        export(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_one_light_is_folded_in(tmp_path: Path) -> None:
    asset = smooth_asset()
    read = export(tmp_path, asset, light=SUN, light_name="sun")
    assert sum(name.startswith("_PRT_") for name in read.attributes) == 16
    assert read.extras["quantity"] == "radiance"
    assert read.extras["light"]["name"] == "sun"
    assert passes_selftest(read)
    np.testing.assert_allclose(read.extras["light"]["coefficients"], SUN)


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_light_of_other_degrees(tmp_path: Path, degree: int) -> None:
    read = export(tmp_path, smooth_asset(degree=degree), degree=2)
    assert read.extras["light_degree"] == degree
    assert passes_selftest(read)


def test_an_asset_of_one_light_and_one_of_one_view(tmp_path: Path) -> None:
    asset = smooth_asset()
    coefficients = np.asarray(asset.coefficients)
    lit = dataclasses.replace(asset, coefficients=coefficients[:, :, :1], quantity="radiance")
    read = export(tmp_path, lit)
    assert passes_selftest(read)
    assert read.extras["light"]["name"] == "the light of the asset"
    still = dataclasses.replace(asset, coefficients=coefficients[:, :1])
    read = export(tmp_path, still)
    assert (read.extras["view_degree"], sum(name.startswith("_PRT_") for name in read.attributes)) == (0, 9)
    assert passes_selftest(read)


def test_our_reader_finds_the_mesh_where_it_was(tmp_path: Path) -> None:
    for up, unit, scale in (("y", "unit", 1.0), ("z", "mm", 1e-3), ("y", "25.4 mm", 0.0254)):
        asset = dataclasses.replace(smooth_asset(), up=up, unit=unit)
        export(tmp_path, asset)
        mesh = prt.read_mesh(tmp_path / "x.glb")
        true, normals = asset.mesh.positions, asset.mesh.normals
        if up == "z":
            true, normals = (values[:, [0, 2, 1]] * [1.0, 1.0, -1.0] for values in (true, normals))
        np.testing.assert_allclose(mesh.positions, scale * true, atol=1e-6 * scale * 5.0)
        np.testing.assert_allclose(mesh.normals, normals, atol=1e-5)
        np.testing.assert_array_equal(mesh.faces, asset.mesh.faces)


def test_the_surface_is_stated_for_reflections(tmp_path: Path) -> None:
    asset = dataclasses.replace(smooth_asset(), provenance={"eta": 1.5, "roughness": 0.2})
    assert [export(tmp_path, asset).extras[key] for key in ("eta", "roughness")] == [1.5, 0.2]
    assert [export(tmp_path).extras[key] for key in ("eta", "roughness")] == [1.0, None]


def test_texels_number_the_vertices(tmp_path: Path) -> None:
    read = export(tmp_path)
    width, height = read.extras["texels"]["width"], read.extras["texels"]["height"]
    texel = np.floor(read.attributes["TEXCOORD_1"] * [width, height]).astype(int)
    np.testing.assert_array_equal(texel[:, 1] * width + texel[:, 0], np.arange(read.extras["vertices"]))


def test_colours_are_the_mean_radiance_under_the_stated_light(tmp_path: Path) -> None:
    asset = smooth_asset()
    read = export(tmp_path, asset)
    stated = read.extras["light"]
    sky = prt.project_environment(prt.read_environment(prt.example("sky.hdr")))
    np.testing.assert_allclose(stated["coefficients"], sky)
    radiances = np.einsum("vbkc,kc->vc", np.asarray(asset.coefficients, np.float64), sky) / (8 * 32)
    colours = np.clip(stated["colour_scale"] * radiances, 0.0, 1.0)
    np.testing.assert_allclose(read.attributes["COLOR_0"], colours, atol=1e-5)
    assert 0.9 < read.attributes["COLOR_0"].max() <= 1.0


def test_the_default_light_is_upright_and_a_few_bright_vertices_do_not_darken_the_others(tmp_path: Path) -> None:
    asset = smooth_asset()
    sky = prt.project_environment(prt.read_environment(prt.example("sky.hdr")), up="z")
    np.testing.assert_allclose(
        export(tmp_path, dataclasses.replace(asset, up="z")).extras["light"]["coefficients"], sky
    )
    coefficients, valid = np.asarray(asset.coefficients).copy(), np.ones(len(asset.valid), np.bool_)
    plain = export(tmp_path, asset).extras["light"]["colour_scale"]
    coefficients[7] *= 100.0
    bright = dataclasses.replace(asset, coefficients=coefficients)
    assert export(tmp_path, bright).extras["light"]["colour_scale"] > 0.9 * plain
    valid[:] = False
    valid[::9] = True
    coefficients[7] /= 100.0
    few = export(tmp_path, dataclasses.replace(asset, coefficients=coefficients, valid=valid))
    true = (
        np.einsum("vbkc,kc->vc", coefficients.astype(np.float64), np.array(few.extras["light"]["coefficients"])) / 256
    )
    brightest = np.percentile(np.maximum(true[valid], 0.0), 99)
    assert few.extras["light"]["colour_scale"] == pytest.approx(1.0 / brightest, rel=1e-4)


@pytest.mark.parametrize(("vertices", "kind"), [(2**16 - 1, 5123), (2**16, 5125)])
def test_no_index_is_the_one_that_restarts_a_primitive(vertices: int, kind: int) -> None:
    buffer = glb.Buffer()
    buffer.add_indices(np.array([[0, 1, vertices - 1]]), vertices)
    assert buffer.accessors[0]["componentType"] == kind


def test_texture_coordinates_of_the_mesh_are_kept(tmp_path: Path) -> None:
    mesh = ball()
    uv = np.random.default_rng(0).random((len(mesh.positions), 2))
    read = export(tmp_path, smooth_asset(prt.Mesh(mesh.positions, mesh.faces, mesh.normals, uv=uv)))
    np.testing.assert_allclose(read.attributes["TEXCOORD_0"], uv * [1, -1] + [0, 1], atol=1e-6)


def test_arguments_that_contradict_are_refused(tmp_path: Path) -> None:
    asset = smooth_asset()
    with pytest.raises(QueryError, match="error chooses the degree"):
        prt.export_gltf(asset, tmp_path / "x.glb", degree=3, error=0.1)
    with pytest.raises(QueryError, match="quantize: expected 'int8'"):
        prt.export_gltf(asset, tmp_path / "x.glb", quantize="int16")
    with pytest.raises(QueryError, match=r"expected shape \[9, 3\]"):
        prt.export_gltf(asset, tmp_path / "x.glb", light=np.ones((4, 3)))
    with pytest.raises(QueryError, match="degree: expected 0 to 8"):
        prt.export_gltf(asset, tmp_path / "x.glb", degree=9)
    assert not list(tmp_path.iterdir())
