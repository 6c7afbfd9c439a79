"""Compression: the error is met and reported, and compact assets are shaded as their decoded form."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from bakers.error_covariance import unknown_covariance
from formats.asset import Asset, check_asset, read_asset, write_asset
from formats.errors import AssetError, QueryError
from formats.mesh import Mesh
from prt_bake.baking.compact_encoding import encoded_within, untransformed
from prt_bake.baking.compress import compress, compress_file, unpacked
from prt_bake.baking.output.selftest import selftest
from prt_bake.mathematics import sphere
from prt_bake.shading.picture import render_picture, shade, shade_vertices
from tests.cli.command_line import Run
from tests.shading import reference
from tests.shading.test_picture import VIEWS, constant, front, make_asset, make_light
from tests.shapes import ball


def of_rank(rank: int, noise: float, seed=0, vertices=66, bins=64, terms=9, channels=3) -> np.ndarray:
    """Random coefficients [V,B,K,C] of that rank, plus noise."""
    rng = np.random.default_rng(seed)
    parts = (rng.normal(size=(rank, length)) for length in (vertices, bins, terms * channels))
    mixed = np.einsum("rv,rb,rk->vbk", *parts) + noise * rng.normal(size=(vertices, bins, terms * channels))
    return mixed.reshape(vertices, bins, terms, channels)


def asset_with(coefficients: np.ndarray, rings=4, sectors=16, degree=2, storage="float32", **others) -> Asset:
    """An asset of a ball with these coefficients."""
    asset = make_asset(ball(2), rings, sectors, degree, 0, storage, coefficients.shape[1], coefficients.shape[3])
    return dataclasses.replace(asset, coefficients=coefficients.astype(storage), **others)


def added_error(asset: Asset, decoded: np.ndarray) -> np.ndarray:
    """Σ|decoded − original|² [V] of valid vertices."""
    off = decoded.astype(np.float64) - asset.coefficients
    return np.square(off).sum(axis=(1, 2, 3)) * asset.valid


def assert_within(asset: Asset, error: float, compact: Asset) -> None:
    """The decoded coefficients meet the error, and all figures about it are correct."""
    decoded = compact.coefficients[:]
    off, own = added_error(asset, decoded), np.square(asset.coefficients, dtype=np.float64).sum(axis=(1, 2, 3))
    own = own * asset.valid
    added = compact.coefficients.added
    assert added.requested == error
    assert added.total <= error
    total = np.sqrt(off.sum() / own.sum()) if own.any() else 0.0
    assert added.total == pytest.approx(total, rel=1e-3, abs=1e-7)
    ratios = np.sqrt(off[asset.valid] / np.where(own[asset.valid] > 0, own[asset.valid], 1.0))
    assert added.percentile_95 == pytest.approx(np.percentile(ratios, 95), rel=1e-3, abs=1e-7)
    assert added.worst == pytest.approx(ratios.max(), rel=1e-3, abs=1e-7)
    count = np.prod(asset.coefficients.shape[1:])
    np.testing.assert_allclose(
        added.per_vertex, np.sqrt(off / count), rtol=1e-2, atol=1e-6 * np.sqrt(own / count).max()
    )
    expected = np.sqrt(np.square(asset.standard_error.astype(np.float64)).mean(axis=1) + off / count) * asset.valid
    np.testing.assert_allclose(compact.standard_error[:, 0], expected, rtol=1e-2)
    assert (compact.standard_error[:, 0] >= expected * (1 - 1e-5)).all()
    np.testing.assert_array_equal(decoded[~asset.valid], 0.0)


@pytest.mark.parametrize(("rank", "noise"), [(1, 0.0), (3, 0.01), (40, 0.3), (1, 1.0)])
@pytest.mark.parametrize("error", [0.2, 0.005, 2e-5])
def test_the_error_is_met_and_reported(tmp_path, rank, noise, error) -> None:
    asset = asset_with(of_rank(rank, noise, seed=rank))
    compact = compress(asset, error)
    assert_within(asset, error, compact)
    write_asset(compact, tmp_path / "a.h5")
    assert check_asset(tmp_path / "a.h5") == []
    again = read_asset(tmp_path / "a.h5")
    np.testing.assert_array_equal(again.coefficients[:], compact.coefficients[:])
    np.testing.assert_array_equal(again.standard_error, compact.standard_error)


def bright_and_dark() -> np.ndarray:
    return of_rank(5, 0.01) * np.geomspace(1e-3, 1e4, 66)[:, None, None, None]


def one_coefficient() -> np.ndarray:
    coefficients = np.zeros((66, 64, 9, 3))
    coefficients[7, 3, 2, 1] = 1e6
    return coefficients


def one_vertex() -> Asset:
    asset = asset_with(of_rank(3, 0.01))
    mesh = Mesh(asset.mesh.positions[:1], asset.mesh.faces[:0], asset.mesh.normals[:1])
    return dataclasses.replace(
        asset,
        mesh=mesh,
        tangents=asset.tangents[:1],
        coefficients=asset.coefficients[:1],
        standard_error=asset.standard_error[:1],
        valid=asset.valid[:1],
    )


VARIANTS = {
    "zero": lambda: asset_with(np.zeros((66, 64, 9, 3))),
    "constant": lambda: asset_with(np.full((66, 64, 9, 3), 0.7)),
    "bright and dark vertices": lambda: asset_with(bright_and_dark()),
    "one coefficient": lambda: asset_with(one_coefficient()),
    "one view": lambda: asset_with(of_rank(3, 0.01, bins=1)),
    "one channel": lambda: asset_with(of_rank(3, 0.01, channels=1)),
    "one view and one channel": lambda: asset_with(of_rank(3, 0.01, bins=1, channels=1)),
    "one bin": lambda: asset_with(of_rank(3, 0.01, bins=1), 1, 1),
    "one ring": lambda: asset_with(of_rank(3, 0.01, bins=5), 1, 5),
    "degree 0": lambda: asset_with(of_rank(3, 0.01, terms=1), degree=0),
    "degree 8": lambda: asset_with(of_rank(3, 0.01, terms=81), degree=8),
    "float16": lambda: asset_with(of_rank(3, 0.01), storage="float16"),
    "radiance": lambda: asset_with(of_rank(3, 0.01, terms=1), quantity="radiance"),
    "not all valid": lambda: asset_with(of_rank(3, 0.01), valid=np.arange(66) % 5 > 1, complete=False),
    "one vertex": one_vertex,
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_any_asset_can_be_compressed_and_is_shaded_as_its_decoded_form(tmp_path, variant) -> None:
    asset = VARIANTS[variant]()
    asset = dataclasses.replace(
        asset,
        coefficients=asset.coefficients * asset.valid[:, None, None, None],
        standard_error=asset.standard_error * asset.valid[:, None],
    )
    compact = compress(asset, 0.005)
    assert_within(asset, 0.005, compact)
    write_asset(compact, tmp_path / "a.h5")
    assert check_asset(tmp_path / "a.h5") == []
    again = read_asset(tmp_path / "a.h5")
    assert (again.quantity, again.degree, again.complete) == (asset.quantity, asset.degree, asset.complete)
    light = None if asset.quantity == "radiance" else make_light(asset.degree)
    views = VIEWS[: len(asset.valid)]
    shaded, expected = (shade(each, light, views) for each in (again, unpacked(again)))
    np.testing.assert_allclose(shaded, expected, rtol=0, atol=2e-6 * max(expected.max(), 1e-30))
    assert expected.any() or variant in ("zero", "one coefficient")


def test_shading_a_compact_asset_agrees_with_the_reference() -> None:
    """At all views, including the pole, the seam and below the horizon."""
    compact = compress(asset_with(of_rank(6, 0.01) + 20.0), 0.01)
    light = make_light()
    expected = np.maximum(reference.reconstruct(unpacked(compact), light, VIEWS), 0.0)
    np.testing.assert_allclose(shade(compact, light, VIEWS), expected, rtol=0, atol=1e-5 * expected.max())
    upright = np.maximum(reference.reconstruct(unpacked(compact), light, compact.mesh.normals), 0.0)
    np.testing.assert_allclose(shade(compact, light, compact.mesh.normals), upright, rtol=0, atol=1e-5 * upright.max())
    some = np.arange(66) % 13 == 1
    part = shade_vertices(compact, light, VIEWS, some).radiance
    np.testing.assert_array_equal(part[some], shade(compact, light, VIEWS)[some])
    assert not part[~some].any()


def test_a_picture_of_a_compact_asset_is_close_to_that_of_the_original() -> None:
    asset = make_asset(ball(2), 4, 16)
    compact, original = (render_picture(each, constant(), front()).image for each in (compress(asset, 0.005), asset))
    assert np.sqrt(np.square(compact - original).mean()) < 0.02 * np.sqrt(np.square(original).mean())


@pytest.mark.parametrize("quantity", ["transfer", "radiance"])
def test_the_selftest_matches_the_compact_coefficients(quantity) -> None:
    light = make_light() if quantity == "radiance" else None
    asset = asset_with(of_rank(3, 0.05, terms=9 if light is None else 1), quantity=quantity)
    asset = dataclasses.replace(asset, selftest=selftest(asset, np.array([4]), asset.coefficients[4:5], light))
    compact = compress(asset, 0.1)
    expected = selftest(asset, np.array([4]), compact.coefficients[4:5], light)
    for name, values in expected.items():
        np.testing.assert_allclose(compact.selftest[name], values, rtol=1e-5, atol=1e-4)
    assert not np.allclose(compact.selftest["radiance"], asset.selftest["radiance"], rtol=1e-3)


def test_a_larger_error_needs_fewer_bytes(tmp_path) -> None:
    asset = asset_with(of_rank(20, 0.1))
    sizes = []
    for error in (1e-4, 1e-3, 1e-2, 1e-1):
        write_asset(asset, tmp_path / "raw.h5")
        sizes.append(compress_file(tmp_path / "raw.h5", tmp_path / "a.h5", error).after)
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[-1] < 0.5 * sizes[0]


def test_smooth_views_need_a_fiftieth_of_the_bytes(tmp_path) -> None:
    """Views that vary like harmonics of the third degree, at 16×64 bins."""
    rng = np.random.default_rng(0)
    x, y, z = sphere.view_bins(16, 64).T
    smooth = np.stack([x**i * y**j * z**k for i in range(4) for j in range(4 - i) for k in range(4 - i - j)])
    mixed = np.einsum("vpk,pb->vbk", rng.normal(size=(66, len(smooth), 27)), smooth)
    write_asset(asset_with(mixed.reshape(66, 1024, 9, 3), 16, 64, storage="float16"), tmp_path / "raw.h5")
    outcome = compress_file(tmp_path / "raw.h5", tmp_path / "a.h5", 0.005)
    assert outcome.after * 50 < outcome.raw == 66 * 110_592
    assert outcome.after < outcome.before


def test_compression_is_deterministic() -> None:
    one, two = (compress(asset_with(of_rank(20, 0.1)), 0.003).coefficients for _ in range(2))
    for name in ("starts", "components", "values", "view_matrix", "channels"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))


def test_compressing_an_open_file_equals_compressing_its_array(tmp_path, monkeypatch) -> None:
    """With a sample of the vertices the error is still met."""
    asset = asset_with(of_rank(20, 0.1), valid=np.arange(66) % 4 > 0)
    asset = dataclasses.replace(asset, coefficients=asset.coefficients * asset.valid[:, None, None, None])
    write_asset(asset, tmp_path / "a.h5")
    opened = read_asset(tmp_path / "a.h5", load=False)
    np.testing.assert_array_equal(compress(opened, 0.01).coefficients[:], compress(asset, 0.01).coefficients[:])
    opened.close()
    monkeypatch.setattr("prt_bake.baking.compress.SAMPLE_BYTES", 256)
    monkeypatch.setattr("prt_bake.baking.compress.LEAST_SAMPLE", 7)
    assert_within(asset_with(of_rank(20, 0.1)), 0.01, compress(asset_with(of_rank(20, 0.1)), 0.01))


def test_an_asset_that_does_not_get_smaller_is_copied(tmp_path) -> None:
    asset = make_asset(ball(0), 1, 1, 0)
    write_asset(asset, tmp_path / "raw.h5")
    outcome = compress_file(tmp_path / "raw.h5", tmp_path / "a.h5", 1e-6)
    assert outcome.compact is None
    assert outcome.after == outcome.before
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "raw.h5").read_bytes()


@pytest.mark.parametrize("error", [0.0, -0.1, 1.0, 9e-7, float("nan"), float("inf")])
def test_errors_out_of_range_raise(error: float) -> None:
    with pytest.raises(QueryError, match="error: must be a relative RMSE"):
        compress(asset_with(of_rank(1, 0.1)), error)


def test_a_damaged_part_is_refused_by_the_name_of_the_file(tmp_path: Path) -> None:
    write_asset(asset_with(of_rank(1, 0.1)), tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5") as file:
        chunk = file["transfer/coefficients"].id.get_chunk_info(0)
    content = bytearray((tmp_path / "a.h5").read_bytes())
    middle = chunk.byte_offset + chunk.size // 2
    content[middle : middle + 40] = bytes(40)
    (tmp_path / "a.h5").write_bytes(content)
    with pytest.raises(AssetError, match=r"a\.h5: is damaged: the coefficients of vertices 0 to 63 cannot be decompr"):
        compress_file(tmp_path / "a.h5", tmp_path / "b.h5", 0.1)
    assert not (tmp_path / "b.h5").exists()


def test_assets_that_cannot_be_compressed_raise(tmp_path) -> None:
    asset = asset_with(of_rank(1, 0.1))
    with pytest.raises(QueryError, match="is compact already"):
        compress(compress(asset, 0.1), 0.1)
    with pytest.raises(QueryError, match="expected at least one valid vertex"):
        compress(dataclasses.replace(asset, valid=np.zeros(66, np.bool_)), 0.1)
    broken = asset.coefficients.copy()
    broken[17, 3, 2, 1] = np.nan
    with pytest.raises(QueryError, match="vertex 17 are not finite"):
        compress(dataclasses.replace(asset, coefficients=broken), 0.1)
    without = dataclasses.replace(asset, coefficients=broken, valid=np.arange(66) != 17)
    assert np.isfinite(compress(without, 0.1).coefficients[:]).all()
    write_asset(asset, tmp_path / "a.h5")
    with pytest.raises(QueryError, match="is the asset itself"):
        compress_file(tmp_path / "a.h5", tmp_path / "a.h5", 0.1)
    assert check_asset(tmp_path / "a.h5") == []


def test_the_command_prints_its_result(tmp_path, prtbake: Run) -> None:
    asset = asset_with(of_rank(3, 0.01, bins=256), 8, 32)
    write_asset(dataclasses.replace(asset, error_covariance=unknown_covariance(len(asset.valid), 9)), tmp_path / "a.h5")
    ended = prtbake("compress", tmp_path / "a.h5", "--error", "0.01")
    assert ended.code == 0, ended.err
    compact = read_asset(tmp_path / "a.compact.h5")
    assert compact.error_covariance is not None
    table = compact.provenance["compression"]
    for text in (
        f"1/{(tmp_path / 'a.h5').stat().st_size / (tmp_path / 'a.compact.h5').stat().st_size:.1f}",
        f"{table['bytes_before']:,}",
        f"{table['bytes_after']:,}",
        "at most 1.000%",
    ):
        assert text in ended.out
    assert all(row["form"] in ended.out for row in table["tried"])
    rows = [line for line in ended.out.splitlines() if line.startswith("  ")]
    assert len(rows) == len(set(rows))
    assert prtbake("check", tmp_path / "a.compact.h5").code == 0
    assert "compact: added relative RMSE" in prtbake("info", tmp_path / "a.compact.h5", "--all").out
    for words, sentence in (
        ((tmp_path / "a.compact.h5",), "is compact already"),
        ((tmp_path / "a.h5", "--error", "2"), "must be a relative RMSE"),
        ((tmp_path / "none.h5",), "no such file"),
        ((tmp_path / "a.h5", "-o", tmp_path / "a.h5"), "is also the input given as ASSET"),
        ((tmp_path / "a.h5", "--out", tmp_path / "a.png"), "expected a name that ends in .h5"),
    ):
        failed = prtbake("compress", *words, "--force")
        assert failed.code == 1
        assert sentence in failed.err


def test_progress_never_decreases() -> None:
    asset = asset_with(of_rank(3, 0.1))
    trial = dataclasses.replace(untransformed(asset, 0.01), step=100.0 * untransformed(asset, 0.01).step)
    shown: list[tuple[float, str]] = []
    assert encoded_within(asset, trial, 0.01, lambda *row: shown.append(row)) is not None
    assert {text for _, text in shown} == {"encoding", "encoding again, in finer steps"}
    shares = [share for share, _ in shown]
    assert shares == sorted(shares)
    assert shares[-1] <= 1.0


def test_shading_a_compact_asset_does_not_load_torch(tmp_path) -> None:
    write_asset(compress(asset_with(of_rank(3, 0.01)), 0.01), tmp_path / "a.h5")
    program = (
        "import sys, numpy, prt_bake as prt\n"
        f"asset = prt.read_asset({str(tmp_path / 'a.h5')!r})\n"
        "prt.shade(asset, numpy.ones((9, 3)), [0, 0, 9.0])\n"
        "print('torch' in sys.modules)\n"
    )
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=600, check=False)
    assert (ran.returncode, ran.stdout.strip()) == (0, "False"), ran.stderr
