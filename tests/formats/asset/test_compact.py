"""Compact assets: every valid one survives a round trip, plain h5py can decode it, invalid data is refused."""

import dataclasses
import re
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from formats.asset import Asset, check_asset, read_asset, write_asset
from formats.asset.compact_file import digit_planes, join_sparse, round_up, to_sparse
from formats.asset.compact_record import AddedError, CompactCoefficients, FactorisedViews, LearnedViews
from formats.errors import AssetError
from tests import ROOT
from tests.formats.asset.test_asset import assert_same, make_asset, make_covariance
from tests.formats.asset.test_faults import changed, put

LARGEST = 2**30


def compact_asset(
    vertices=5, rings=2, sectors=3, degree=1, seed=0, learned=True, views=None, channels=3, largest=300, **others
) -> Asset:
    """An asset with random codes, about half of them 0."""
    rng = np.random.default_rng(seed)
    rows = others.pop("error_covariance", None)
    plain = make_asset(vertices, rings, sectors, degree, seed, views=views, channels=channels, **others)
    terms = 1 if plain.quantity == "radiance" else (degree + 1) ** 2
    width = 4
    if learned:
        codes = rng.integers(-largest, largest + 1, (3, plain.coefficients.shape[1])).astype(np.int32)
        basis = LearnedViews(codes, rng.random(3).astype(np.float32))
    else:
        sizes = (1, 1) if views == 1 else (rings, sectors)
        basis = FactorisedViews(*(rng.normal(size=(size, size)).astype(np.float32) for size in sizes))
    functions = len(basis.matrix)
    pairs = np.sort(rng.permutation(functions * width)[:6])
    components = len(pairs)
    dense = rng.integers(-largest, largest + 1, (components, vertices)) * (rng.random((components, vertices)) < 0.5)
    dense = dense * plain.valid
    starts, which, values = join_sparse([to_sparse(dense[:, :2]), to_sparse(dense[:, 2:])], components)
    compact = CompactCoefficients(
        step=0.01,
        views=basis,
        channels=rng.normal(size=(width, terms, channels)).astype(np.float32),
        view_component=pairs % functions,
        channel_component=pairs // functions,
        starts=starts,
        components=which,
        values=values,
        added=AddedError(0.01, 0.005, 0.006, 0.02, round_up(rng.random(vertices))),
    )
    return dataclasses.replace(
        plain,
        coefficients=compact,
        standard_error=round_up(rng.random((vertices, 1))),
        storage="float32",
        error_covariance=None if rows is None else make_covariance(vertices, terms, channels, rows or None),
    )


def assert_same_compact(again: CompactCoefficients, compact: CompactCoefficients) -> None:
    for name in ("step", "shape", "dtype"):
        assert getattr(again, name) == getattr(compact, name), name
    for name in ("channels", "view_component", "channel_component", "starts", "components", "values"):
        np.testing.assert_array_equal(getattr(again, name), getattr(compact, name), err_msg=name)
    np.testing.assert_array_equal(again.view_matrix, compact.view_matrix)
    for field in dataclasses.fields(AddedError):
        np.testing.assert_array_equal(getattr(again.added, field.name), getattr(compact.added, field.name))


@st.composite
def valid_compact_assets(draw) -> Asset:
    vertices, degree = draw(st.integers(3, 7)), draw(st.integers(0, 3))
    terms = (degree + 1) ** 2
    return compact_asset(
        vertices,
        draw(st.integers(1, 3)),
        draw(st.integers(1, 4)),
        degree,
        seed=draw(st.integers(0, 2**32)),
        learned=draw(st.booleans()),
        views=draw(st.sampled_from([None, 1])),
        channels=draw(st.sampled_from([1, 3])),
        largest=draw(st.sampled_from([0, 1, 127, 128, 40_000, LARGEST])),
        valid=draw(st.lists(st.booleans(), min_size=vertices, max_size=vertices)),
        quantity=draw(st.sampled_from(["transfer", "radiance"])),
        complete=draw(st.booleans()),
        error_covariance=draw(st.sampled_from([None, 0, 2])),
        selftest={
            "light": np.ones((terms, 3)),
            "vertex": np.arange(2),
            "outgoing": np.eye(3)[:2],
            "radiance": np.ones((2, 3)),
        }
        if draw(st.booleans())
        else {},
    )


@settings(max_examples=25, deadline=None, derandomize=True, database=None)
@given(asset=valid_compact_assets())
def test_every_valid_compact_asset_survives_write_and_read(tmp_path_factory, asset) -> None:
    path = tmp_path_factory.mktemp("asset") / "a.h5"
    write_asset(asset, path)
    assert check_asset(path) == []
    for load in (True, False):
        again = read_asset(path, load=load)
        again.close()
        assert_same_compact(again.coefficients, asset.coefficients)
        assert_same(again, asset)
    write_asset(again, path)
    assert_same_compact(read_asset(path).coefficients, asset.coefficients)


@settings(max_examples=60, deadline=None, derandomize=True, database=None)
@given(codes=st.lists(st.integers(-LARGEST, LARGEST), min_size=1, max_size=9))
def test_digits_add_up_to_the_codes(codes) -> None:
    planes = digit_planes(np.array(codes))
    assert [plane.dtype for plane in planes] == [np.int8] * len(planes)
    assert len(planes) <= 4
    assert sum(plane.astype(np.int64) * 256**d for d, plane in enumerate(planes)).tolist() == codes
    if max(map(abs, codes)) < 128:
        assert len(planes) == 1


def test_standard_errors_are_never_rounded_down() -> None:
    errors = np.random.default_rng(0).lognormal(0.0, 20.0, 1000).astype(np.float32)
    rounded = round_up(errors)
    assert (rounded >= errors).all()
    np.testing.assert_allclose(rounded, errors, rtol=2.0**-8)
    np.testing.assert_array_equal(round_up(np.zeros(3)), 0.0)


@pytest.mark.parametrize("learned", [True, False])
def test_plain_h5py_decodes_it_as_documented(tmp_path, learned) -> None:
    """The reader in docs/reference/compact_asset.md."""
    text = (ROOT / "docs" / "reference" / "compact_asset.md").read_text(encoding="utf-8")
    reader = next(code for code in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if "def decoded" in code)
    page: dict[str, Any] = {}
    exec(reader, page)
    asset = compact_asset(learned=learned, largest=40_000)
    write_asset(asset, tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5") as file:
        assert file.attrs["format_version"] == "1.0"
        assert "transfer" not in file
        group = file["transfer_compact"]
        for name in group:
            assert group[name].compression in ("gzip", None)
            assert group[name].dtype.str[0] in "<|"
        for name in [*group, *group.attrs]:
            assert re.search(rf"`{re.sub('[0-9]+$', '[0-9…]', name)}", text), name
    decoded = page["decoded"](tmp_path / "a.h5")
    scale = abs(decoded).max()
    np.testing.assert_allclose(asset.coefficients[:], decoded, rtol=0, atol=1e-6 * scale)


def test_compact_coefficients_are_indexed_like_an_array() -> None:
    compact = compact_asset(vertices=150).coefficients
    decoded = compact[:]
    assert (decoded.shape, len(compact), decoded.dtype) == (compact.shape, 150, np.float32)
    mask = np.arange(150) % 3 == 1
    for key in (7, -1, slice(60, 140), slice(None, None, -7), [3, 1, 3], mask, ..., np.array([], int)):
        np.testing.assert_allclose(compact[key], decoded[key], rtol=1e-6, atol=1e-7)
    np.testing.assert_array_equal(np.asarray(compact), decoded)
    with pytest.raises(IndexError):
        compact[150]


def test_chunks_of_zeros_are_not_written(tmp_path) -> None:
    asset = compact_asset(vertices=40, largest=100)
    write_asset(asset, tmp_path / "a.h5")
    write_asset(dataclasses.replace(compact_asset(vertices=40, largest=0)), tmp_path / "zero.h5")
    with h5py.File(tmp_path / "a.h5") as some, h5py.File(tmp_path / "zero.h5") as none:
        assert some["transfer_compact/digits_0"].id.get_num_chunks() == 1
        assert none["transfer_compact/digits_0"].id.get_num_chunks() == 0
        assert "digits_1" not in some["transfer_compact"]
    assert not read_asset(tmp_path / "zero.h5").coefficients[:].any()


CHANGES = {
    "/transfer_compact/digits_0 is missing": lambda group: group.__delitem__("digits_0"),
    "/transfer_compact/valid is missing": lambda group: group.__delitem__("valid"),
    "/transfer_compact/view_digits_0 is missing": lambda group: group.__delitem__("view_digits_0"),
    "/transfer_compact/ring_basis is missing": lambda group: group.__delitem__("view_scale"),
    "/transfer_compact: the attribute step is missing": lambda group: group.attrs.__delitem__("step"),
    "/transfer_compact: the attribute step is nan": lambda group: group.attrs.__setitem__("step", np.nan),
    "/transfer_compact: the attribute error is -1": lambda group: group.attrs.__setitem__("error", -1.0),
    "/transfer_compact: quantity is 'colour'": lambda group: group.attrs.__setitem__("quantity", "colour"),
    r"/transfer_compact/digits_0 has shape \[6, 4\]; expected \[P = 6, V = 5\]": lambda group: put(
        group, "digits_0", np.zeros((6, 4), np.int8)
    ),
    "/transfer_compact/digits_1 has type float64": lambda group: put(group, "digits_1", np.zeros((6, 5))),
    "/transfer_compact/digits_0 has type int16": lambda group: put(group, "digits_0", np.zeros((6, 5), np.int16)),
    "/transfer_compact/digits_1 is missing": lambda group: group.__delitem__("digits_1"),
    "has datasets digits_0 to digits_1; expected 3 of them, as its attribute digits says": lambda group: (
        group.__delitem__("digits_2")
    ),
    "has datasets digits_0 to digits_3; expected 3 of them": lambda group: group.copy("digits_1", "digits_3"),
    "has datasets view_digits_0 to view_digits_3; expected 3 of them": lambda group: group.copy(
        "view_digits_0", "view_digits_3"
    ),
    "/transfer_compact/digits_4: expected at most 4 digits": lambda group: group.copy("digits_0", "digits_4"),
    r"/transfer_compact/channel_basis has shape \[4, 9, 3\]; expected \[J = 4, K = 4 or 1, 3 or 1\]": lambda group: put(
        group, "channel_basis", np.zeros((4, 9, 3), "f4")
    ),
    "/transfer_compact/channel_basis: 1 of 48 values are not finite": lambda group: changed(
        group, "channel_basis", (1, 2, 0), np.inf
    ),
    "/transfer_compact/view_scale: 1 of 3 values are not finite": lambda group: changed(group, "view_scale", 1, np.nan),
    "/transfer_compact/added_error: 1 of 5": lambda group: changed(group, "added_error", 1, np.nan),
    "/transfer_compact/view_component: 1 of 6 select": lambda group: changed(group, "view_component", 0, 3),
    "/transfer_compact/channel_component: 1 of 6 select": lambda group: changed(group, "channel_component", 5, 4),
    "1 components are the product of the same": lambda group: (
        changed(group, "view_component", 1, group["view_component"][0]),
        changed(group, "channel_component", 1, group["channel_component"][0]),
    ),
    "/transfer_compact/channel_component: 1 of 6 descend": lambda group: put(
        group, "channel_component", np.array([0, 0, 1, 2, 1, 3])
    ),
    "/transfer_compact/standard_error: 1 of 5 rows are negative": lambda group: changed(group, "standard_error", 2, -1),
    r"/transfer_compact/view_digits_0 has shape \[3, 5\]; expected \[R = 3, B = 6 or 1\]": lambda group: put(
        group, "view_digits_0", np.zeros((3, 5), np.int8)
    ),
}


@pytest.mark.parametrize("sentence", CHANGES)
def test_every_fault_is_named(tmp_path, sentence) -> None:
    write_asset(compact_asset(largest=40_000), tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        CHANGES[sentence](file["transfer_compact"])
    faults = check_asset(tmp_path / "a.h5")
    assert any(re.search(sentence, fault) for fault in faults), faults
    with pytest.raises(AssetError):
        read_asset(tmp_path / "a.h5")


def test_a_file_that_does_not_state_its_digits_is_read(tmp_path) -> None:
    asset = compact_asset(largest=40_000)
    write_asset(asset, tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        for name in ("digits", "view_digits"):
            del file["transfer_compact"].attrs[name]
    assert_same_compact(read_asset(tmp_path / "a.h5").coefficients, asset.coefficients)


def test_a_damaged_chunk_is_refused(tmp_path) -> None:
    write_asset(compact_asset(300, 4, 16), tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5") as file:
        chunk = file["transfer_compact/digits_0"].id.get_chunk_info(0)
    content = bytearray((tmp_path / "a.h5").read_bytes())
    middle = chunk.byte_offset + chunk.size // 2
    content[middle : middle + 40] = bytes(40)
    (tmp_path / "a.h5").write_bytes(content)
    assert any("is damaged" in fault for fault in check_asset(tmp_path / "a.h5"))
    with pytest.raises(AssetError, match="is damaged"):
        read_asset(tmp_path / "a.h5")
