"""Assets: every valid one survives a round trip, the file has the documented layout, invalid data is refused."""

import dataclasses
import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from formats.asset import Asset, AssetWriter, check_asset, read_asset, write_asset
from formats.asset.asset_file import AssetFile
from formats.asset.error_covariance import ErrorCovariance, triangle
from formats.asset.total_error import ErrorInterval
from formats.atomic import remove_parts
from formats.errors import AssetError
from formats.mesh import Mesh
from prt_bake.mathematics.sphere import view_bins


def perpendicular(normals: np.ndarray) -> np.ndarray:
    tangents = np.cross(normals, np.roll(normals, 1, axis=1) + np.array([0.1, 0.2, 0.3]))
    return tangents / np.linalg.norm(tangents, axis=1, keepdims=True)


def make_asset(
    vertices=5, rings=2, sectors=3, degree=1, seed=0, storage="float32", views=None, channels=3, valid=None, **others
) -> Asset:
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(vertices, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    faces = np.stack([np.arange(vertices), np.roll(np.arange(vertices), 1), np.roll(np.arange(vertices), 2)], axis=1)
    bins, terms = rings * sectors, (degree + 1) ** 2
    valid = np.ones(vertices, bool) if valid is None else np.array(valid)
    shape = (vertices, bins if views is None else views, terms, channels)
    coefficients = rng.normal(size=shape).astype(storage) * valid[:, None, None, None]
    return Asset(
        mesh=Mesh(rng.normal(size=(vertices, 3)), faces, normals, uv=rng.random((vertices, 2))),
        tangents=perpendicular(normals),
        rings=rings,
        sectors=sectors,
        directions=view_bins(rings, sectors),
        degree=degree,
        check_directions=np.eye(3)[:2],
        check_values=rng.normal(size=(2, terms)),
        coefficients=coefficients,
        standard_error=(0.1 * rng.random(shape[:2]) * valid[:, None]).astype(np.float32),
        valid=valid,
        storage=storage,
        **others,
    )


def make_covariance(vertices: int, terms: int, channels: int, rows: int | None, seed: int = 0) -> ErrorCovariance:
    """An error covariance with a row for each vertex, or with `rows` shared rows."""
    rng = np.random.default_rng(seed)
    count = vertices if rows is None else rows
    factors = rng.normal(size=(count, terms, terms))
    covariance = factors @ factors.transpose(0, 2, 1)
    covariance *= (terms / np.trace(covariance, axis1=1, axis2=2))[:, None, None]
    relative = rng.uniform(0.5, 1.5, (count, channels))
    return ErrorCovariance(
        covariance[:, *triangle(terms)],
        relative / relative.mean(axis=1, keepdims=True),
        rng.random((count, 2)),
        None if rows is None else rng.integers(0, rows, vertices),
    )


def assert_same_covariance(again: ErrorCovariance | None, errors: ErrorCovariance | None) -> None:
    assert (again is None) == (errors is None)
    if again is None or errors is None:
        return
    for name, size in (("covariance", 8.0), ("channels", 2.0), ("apart", 1.0)):
        found, expected = getattr(again, name), getattr(errors, name)
        np.testing.assert_allclose(found, expected, rtol=0, atol=size * 2.0**-10, err_msg=name)
    assert (again.row is None) == (errors.row is None)
    if again.row is not None:
        np.testing.assert_array_equal(again.row, errors.row)


def assert_same(again: Asset, asset: Asset) -> None:
    for name in ("coefficients", "standard_error", "valid", "directions", "check_directions", "check_values"):
        np.testing.assert_array_equal(getattr(again, name), getattr(asset, name), err_msg=name)
    for name in ("rings", "sectors", "degree", "up", "handedness", "unit", "quantity", "folded_in", "left_out"):
        assert getattr(again, name) == getattr(asset, name), name
    for name in ("complete", "provenance", "storage", "eta"):
        assert getattr(again, name) == getattr(asset, name), name
    np.testing.assert_array_equal(again.error_vs_time, asset.error_vs_time)
    assert_same_covariance(again.error_covariance, asset.error_covariance)
    assert set(again.selftest) == set(asset.selftest)
    for name in asset.selftest:
        np.testing.assert_array_equal(again.selftest[name], asset.selftest[name], err_msg=name)
    half_step = 2.0**-24
    for found, expected, size in (
        (again.mesh.positions, asset.mesh.positions, asset.mesh.diagonal),
        (again.mesh.normals, asset.mesh.normals, 1),
        (again.tangents, asset.tangents, 1),
        (again.mesh.uv, asset.mesh.uv, 1),
    ):
        np.testing.assert_allclose(found, expected, rtol=0, atol=half_step * size)
    np.testing.assert_array_equal(again.mesh.faces, asset.mesh.faces)
    if asset.mesh.source_vertex is None:
        assert again.mesh.source_vertex is None
    else:
        np.testing.assert_array_equal(again.mesh.source_vertex, asset.mesh.source_vertex)


ROWS = st.sampled_from([None, 1, 2, 300])
TEXT = st.text(st.characters(blacklist_categories=["Cs"], blacklist_characters="\0"), max_size=20)


@st.composite
def valid_assets(draw) -> Asset:
    vertices, rings, sectors = draw(st.integers(3, 7)), draw(st.integers(1, 3)), draw(st.integers(1, 4))
    degree, radiance = draw(st.integers(0, 3)), draw(st.booleans())
    terms, rows = (degree + 1) ** 2, draw(st.integers(0, 3))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    asset = make_asset(
        vertices,
        rings,
        sectors,
        degree,
        seed=draw(st.integers(0, 2**32)),
        storage=draw(st.sampled_from(["float16", "float32"])),
        views=draw(st.sampled_from([None, 1])),
        channels=draw(st.sampled_from([1, 3])),
        valid=draw(st.lists(st.booleans(), min_size=vertices, max_size=vertices)),
        up=draw(st.sampled_from(["y", "z"])),
        unit=draw(TEXT),
        complete=draw(st.booleans()),
        quantity="radiance" if radiance else "transfer",
        folded_in=draw(TEXT),
        left_out=draw(st.lists(st.fixed_dictionaries({"item": TEXT, "reason": TEXT, "saving": st.floats(0, 1)}))),
        provenance=draw(st.dictionaries(TEXT.filter(lambda key: key != "eta"), st.integers() | TEXT, max_size=3)),
        error_vs_time=rng.random((rows, 3)),
        selftest={
            "light": rng.normal(size=(terms, 3)),
            "vertex": np.arange(2),
            "outgoing": rng.normal(size=(2, 3)),
            "radiance": rng.random((2, 3)),
        }
        if draw(st.booleans())
        else {},
    )
    if radiance:
        object.__setattr__(asset, "coefficients", asset.coefficients[:, :, :1])
    if draw(st.booleans()):
        errors = make_covariance(vertices, 1 if radiance else terms, asset.coefficients.shape[3], draw(ROWS))
        object.__setattr__(asset, "error_covariance", errors)
    if draw(st.booleans()):
        object.__setattr__(asset.mesh, "source_vertex", np.arange(-1, vertices))
    return asset


@settings(max_examples=40, deadline=None, derandomize=True, database=None)
@given(asset=valid_assets())
def test_every_valid_asset_survives_write_and_read(tmp_path_factory, asset):
    path = tmp_path_factory.mktemp("asset") / "a.h5"
    before = asset.coefficients.copy()
    write_asset(asset, path)
    np.testing.assert_array_equal(asset.coefficients, before)
    assert_same(read_asset(path), asset)
    assert check_asset(path) == []
    lazy = read_asset(path, load=False)
    np.testing.assert_array_equal(lazy.coefficients[...], asset.coefficients)
    write_asset(lazy, path)
    lazy.close()
    assert_same(read_asset(path), asset)


def test_the_file_has_the_documented_layout(tmp_path):
    write_asset(make_asset(40, 4, 64, 2, up="z", storage="float16"), tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5") as file:
        assert (file.attrs["format"], file.attrs["format_version"]) == ("prtbake", "1.0")
        assert (file.attrs["up"], file.attrs["handedness"], file.attrs["complete"]) == ("z", "right", 1)
        assert {"generator", "created", "unit", "colour"} <= set(file.attrs)
        assert json.loads(file.attrs["left_out"]) == []
        mesh = file["mesh"]
        assert mesh["positions"].dtype == "<f4"
        assert mesh["positions"].attrs["origin"].dtype == "<f8"
        assert (mesh["normals"].dtype, mesh["tangents"].dtype, mesh["faces"].dtype) == ("<f4", "<f4", "<u4")
        basis = dict(file["basis"].attrs)
        assert (basis["degree"], basis["order"], basis["sign"]) == (2, "l(l+1)+m", "no Condon-Shortley phase")
        assert (file["basis/check_directions"].shape, file["basis/check_values"].shape) == ((2, 3), (2, 9))
        bins = file["bins"]
        assert (bins["directions"].shape, bins.attrs["rings"], bins.attrs["sectors"]) == ((256, 3), 4, 64)
        assert bins.attrs["solid_angle"] == 2 * np.pi / 256
        transfer = file["transfer"]
        coefficients = transfer["coefficients"]
        assert (coefficients.shape, coefficients.dtype) == ((40, 256, 9, 3), "<f2")
        assert coefficients.chunks[1:] == (256, 9, 3)
        assert coefficients.chunks[0] * 256 * 27 * 2 <= 2**20
        assert (coefficients.compression, coefficients.shuffle) == ("gzip", True)
        assert (coefficients.scaleoffset, coefficients.fletcher32) == (None, False)
        assert (transfer["valid"].dtype, transfer["standard_error"].dtype) == ("u1", "<f4")
        assert transfer.attrs["quantity"] == "transfer"
        assert {"formula", "folded_in"} <= set(transfer.attrs)
        assert isinstance(json.loads(file["provenance/json"][()]), dict)
        assert file["provenance/error_vs_time"].shape == (0, 3)


def test_chunks_of_unbaked_vertices_are_not_written(tmp_path):
    asset = make_asset(64, 16, 64, 2, valid=np.arange(64) < 3, complete=False)
    write_asset(asset, tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5") as file:
        coefficients = file["transfer/coefficients"]
        assert coefficients.id.get_num_chunks() == 1
        assert coefficients.chunks[0] * 110592 <= 2**20
    again = read_asset(tmp_path / "a.h5")
    assert not again.complete
    assert again.valid.sum() == 3
    assert not again.coefficients[3:].any()


def test_blocks_are_accepted_in_any_order_and_size(tmp_path):
    asset = make_asset(50, 8, 32, 2)
    with AssetWriter(tmp_path / "a.h5", asset, storage="float32") as writer:
        for start, end in ((31, 50), (0, 7), (7, 31)):
            writer.write_block(start, asset.coefficients[start:end], asset.standard_error[start:end])
        assert writer.finish({"eta": 1.5}) == ""
    again = read_asset(tmp_path / "a.h5")
    np.testing.assert_array_equal(again.coefficients, asset.coefficients)
    assert again.eta == 1.5


def test_float16_is_kept_if_rounding_is_small(tmp_path):
    asset = make_asset()
    with AssetWriter(tmp_path / "a.h5", asset) as writer:
        writer.write_block(0, asset.coefficients, np.full((5, 6), 0.01))
        assert writer.finish({}) == ""
    again = read_asset(tmp_path / "a.h5")
    np.testing.assert_array_equal(again.coefficients, asset.coefficients.astype(np.float16))


def test_float32_replaces_float16_before_overflow(tmp_path):
    asset = make_asset(60, 16, 64, 1)
    coefficients = asset.coefficients.copy()
    coefficients[50, 3, 2, 1] = 65520
    with AssetWriter(tmp_path / "a.h5", asset) as writer:
        for start in range(0, 60, 10):
            rows = slice(start, start + 10)
            writer.write_block(start, coefficients[rows], np.full((10, 1024), 0.5))
        assert writer.storage == "float32"
        assert "65504" in writer.finish({})
    again = read_asset(tmp_path / "a.h5")
    assert again.coefficients.dtype == np.float32
    np.testing.assert_array_equal(again.coefficients[50:], coefficients[50:])
    # Earlier blocks were already rounded, within a tenth of their standard error.
    np.testing.assert_array_equal(again.coefficients[:50], coefficients[:50].astype(np.float16).astype(np.float32))
    np.testing.assert_array_equal(again.standard_error, np.float32(0.5))
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.h5"]


def test_a_killed_change_to_float32_leaves_files_that_the_next_run_removes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asset, left = make_asset(), list[Path]()

    def note(file: AssetFile, text: str) -> None:
        left.extend(tmp_path.iterdir())

    monkeypatch.setattr(AssetFile, "note", note)
    with AssetWriter(tmp_path / "a.h5", asset) as writer:
        writer.write_block(0, np.full_like(asset.coefficients, 65520), asset.standard_error)
    assert len(left) == 2
    for path in left:
        path.touch()
    remove_parts(tmp_path, "a.h5")
    assert list(tmp_path.iterdir()) == []


def test_float32_replaces_float16_if_rounding_is_large(tmp_path):
    asset = make_asset()
    rounding = asset.coefficients.astype(np.float16).astype(np.float64) - asset.coefficients
    rms = np.sqrt(np.square(rounding).mean())
    for ratio, storage in ((9.9, "float32"), (10.1, "float16")):
        with AssetWriter(tmp_path / "a.h5", asset) as writer:
            writer.write_block(0, asset.coefficients, np.full((5, 6), ratio * rms))
            note = writer.finish({})
        again = read_asset(tmp_path / "a.h5")
        assert (again.storage, bool(note)) == (storage, storage == "float32")
    np.testing.assert_array_equal(again.mesh.faces, asset.mesh.faces)


@pytest.mark.parametrize(("share", "storage"), [(9.9, "float32"), (10.1, "float16")])
def test_float16_is_kept_if_the_network_is_off_by_more(tmp_path, share, storage):
    asset = make_asset()
    rounding = asset.coefficients.astype(np.float16).astype(np.float64) - asset.coefficients
    relative = np.sqrt(np.square(rounding).sum() / np.square(asset.coefficients, dtype=np.float64).sum())
    asset = dataclasses.replace(asset, network_error=ErrorInterval(share * relative))
    with AssetWriter(tmp_path / "a.h5", asset) as writer:
        for rows in (slice(0, 2), slice(2, 5)):
            writer.write_block(rows.start, asset.coefficients[rows], np.zeros((rows.stop - rows.start, 6)))
        writer.finish({})
    assert read_asset(tmp_path / "a.h5").storage == storage


def test_blocks_of_wrong_shape_are_refused(tmp_path):
    asset = make_asset()
    nan = asset.coefficients.copy()
    nan[3, 2, 1, 0] = np.nan
    with AssetWriter(tmp_path / "a.h5", asset) as writer:
        for first, coefficients, errors, sentence in (
            (0, asset.coefficients[:, :5], asset.standard_error, r"expected \[n, 6, 4, 3\] within 5 vertices"),
            (1, asset.coefficients, asset.standard_error, "within 5 vertices"),
            (0, asset.coefficients, asset.standard_error[:4], "standard errors have shape"),
            (0, nan, asset.standard_error, "first is bin 2 of vertex 3"),
            (0, asset.coefficients, -asset.standard_error, "first is bin 0 of vertex 0"),
            (0, asset.coefficients.astype(np.float64) * 1e39, asset.standard_error, "not finite"),
        ):
            with pytest.raises(AssetError, match=sentence):
                writer.write_block(first, coefficients, errors)
    assert list(tmp_path.iterdir()) == []


def test_heads_of_wrong_shape_are_refused(tmp_path):
    for change, sentence in (
        ({"tangents": np.zeros((4, 3))}, r"tangents has shape \[4, 3\]; expected \[5, 3\]"),
        ({"directions": np.zeros((7, 3))}, r"directions has shape \[7, 3\]; expected \[6, 3\]"),
        ({"check_values": np.zeros((2, 9))}, r"expected \[2, 4\]"),
        ({"quantity": "irradiance"}, "'transfer' or 'radiance'"),
    ):
        asset = make_asset()
        for name, value in change.items():
            object.__setattr__(asset, name, value)
        with pytest.raises(AssetError, match=sentence):
            AssetWriter(tmp_path / "a.h5", asset)
    assert list(tmp_path.iterdir()) == []
