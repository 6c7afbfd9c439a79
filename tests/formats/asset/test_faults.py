"""Damaged, foreign and incomplete assets are refused with one sentence that names the fault."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from formats.asset import AssetWriter, check_asset, read_asset, reader, write_asset
from formats.errors import AssetError, StorageError
from formats.hdf5_sink import Sink
from tests import ROOT
from tests.formats.asset.test_asset import make_asset, make_covariance


def assert_refused(path: Path, sentence: str = "") -> None:
    with pytest.raises(AssetError, match=sentence) as caught:
        read_asset(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    faults = check_asset(path)
    assert faults
    assert all(fault.startswith(f"{path}: ") for fault in faults)
    assert any(re.search(sentence, fault) for fault in faults)


def test_a_truncated_asset_is_refused(tmp_path):
    write_asset(make_asset(30, 4, 16, 2), tmp_path / "a.h5")
    content = (tmp_path / "a.h5").read_bytes()
    for tenth in range(10):
        (tmp_path / "cut.h5").write_bytes(content[: len(content) * tenth // 10])
        assert_refused(tmp_path / "cut.h5", "truncated" if tenth else "empty")
    (tmp_path / "cut.h5").write_bytes(content[:-1])
    size = len(content)
    assert_refused(tmp_path / "cut.h5", f"cut.h5: is truncated: has {size - 1} bytes of {size}; copy or bake it again$")


def test_a_damaged_chunk_is_refused(tmp_path):
    write_asset(make_asset(30, 4, 16, 2), tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5") as file:
        chunk = file["transfer/coefficients"].id.get_chunk_info(0)
    content = bytearray((tmp_path / "a.h5").read_bytes())
    middle = chunk.byte_offset + chunk.size // 2
    content[middle : middle + 40] = bytes(40)
    (tmp_path / "a.h5").write_bytes(content)
    where = "/transfer/coefficients: rows 0 to 29 cannot be decompressed"
    assert_refused(tmp_path / "a.h5", f"a.h5: is damaged: {where}; copy or bake it again$")


def test_a_damaged_provenance_is_refused(tmp_path):
    write_asset(make_asset(30, 4, 16, 2), tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5") as file:
        place = file["provenance/json"].id.get_offset()
    content = bytearray((tmp_path / "a.h5").read_bytes())
    content[place : place + 4] = bytes([255, 255, 255, 127])
    (tmp_path / "a.h5").write_bytes(content)
    assert_refused(tmp_path / "a.h5", "is damaged: /provenance/json: the text cannot be read; copy or bake it again$")


@pytest.mark.parametrize("place", ["open", "faults"])
@pytest.mark.parametrize(
    ("cause", "message"),
    [
        (OSError("Can't synchronously read data (filter returned failure during read)"), "is damaged"),
        (RuntimeError("Unable to get group info (wrong B-tree signature)"), "is damaged"),
        (
            OSError(5, "[Errno 5] Can't synchronously read data (file read failed)"),
            "cannot be read: Input/output error",
        ),
    ],
)
def test_errors_of_h5py_are_described_in_plain_words(tmp_path, monkeypatch, place, cause, message):
    write_asset(make_asset(3, 1, 4, 2), tmp_path / "a.h5")

    def fail(*_: object) -> None:
        raise cause

    if place == "open":
        monkeypatch.setattr(h5py, "File", fail)
    else:
        monkeypatch.setattr(reader, "_faults", fail)
    assert_refused(tmp_path / "a.h5", f"{message}.*; copy or bake it again$")
    (fault,) = check_asset(tmp_path / "a.h5")
    assert "synchronously" not in fault
    assert "B-tree" not in fault


def test_coefficients_that_are_all_nan_are_one_fault(tmp_path, monkeypatch):
    monkeypatch.setattr(reader, "_BLOCK_BYTES", 5000)
    write_asset(make_asset(30, 4, 16, 2), tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        file["transfer/valid"][:7] = 0
        file["transfer/valid"][7:] = 1
        file["transfer/coefficients"][...] = np.nan
        assert len(list(reader._blocks(file["transfer"]))) > 3
    fault = "/transfer/coefficients: 23 of 30 vertices have NaN or infinite values in float32, the first is vertex 7"
    assert check_asset(tmp_path / "a.h5") == [f"{tmp_path / 'a.h5'}: {fault}"]


def test_other_files_are_refused(tmp_path):
    (tmp_path / "a.h5").write_text("v 0 0 0\nf 1 2 3\n")
    assert_refused(tmp_path / "a.h5", "expected an HDF5 file")
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["x"] = 1
    assert_refused(tmp_path / "b.h5", "is not an asset of prtbake")
    with pytest.raises(StorageError, match="no such file"):
        read_asset(tmp_path / "missing.h5")


def put(file, name, values):
    del file[name]
    file.create_dataset(name, data=values)


def changed(file, name, place, value):
    values = file[name][...]
    values[place] = value
    put(file, name, values)


BEYOND_FLOAT32 = np.where(np.arange(5) == 3, 1e300, 0.0)[:, None, None, None]
CHANGES = {
    r"format_version 2\.0": lambda file: file.attrs.__setitem__("format_version", "2.0"),
    "format_version missing": lambda file: file.attrs.__delitem__("format_version"),
    "attribute up is 'x'": lambda file: file.attrs.__setitem__("up", "x"),
    "attribute unit is missing": lambda file: file.attrs.__delitem__("unit"),
    "left_out is not a JSON list": lambda file: file.attrs.__setitem__("left_out", "nothing"),
    "/transfer is missing": lambda file: file.__delitem__("transfer"),
    "/mesh/tangents is missing": lambda file: file.__delitem__("mesh/tangents"),
    "/transfer/coefficients is missing": lambda file: file.__delitem__("transfer/coefficients"),
    "/basis: the attribute degree is missing": lambda file: file["basis"].attrs.__delitem__("degree"),
    "/basis: the attribute kind is 'zonal'": lambda file: file["basis"].attrs.__setitem__("kind", "zonal"),
    "/basis: the attribute sign is 'Condon-Shortley phase'; expected 'no Condon-Shortley phase'": lambda file: file[
        "basis"
    ].attrs.__setitem__("sign", "Condon-Shortley phase"),
    "/basis: the attribute degree is -1": lambda file: file["basis"].attrs.__setitem__("degree", -1),
    "/bins: the attribute rings is 0": lambda file: file["bins"].attrs.__setitem__("rings", 0),
    r"/basis/check_values has shape \[2, 4\]; expected \[2, K = 9\]": lambda file: file["basis"].attrs.__setitem__(
        "degree", 2
    ),
    r"shape \[5, 6, 4, 2\]; expected \[V = 5, B = 6 or 1, K = 4 or 1, 3 or 1\]": lambda file: put(
        file, "transfer/coefficients", np.zeros((5, 6, 4, 2), "f4")
    ),
    "/transfer/coefficients has type int32": lambda file: put(
        file, "transfer/coefficients", np.zeros((5, 6, 4, 3), "i4")
    ),
    r"/mesh/normals has shape \[4, 3\]": lambda file: put(file, "mesh/normals", np.zeros((4, 3), "f4")),
    r"/transfer/valid has shape \[4\]": lambda file: put(file, "transfer/valid", np.ones(4, "u1")),
    "/transfer/coefficients: 1 of 5 vertices have NaN .* vertex 2": lambda file: changed(
        file, "transfer/coefficients", (2, 1, 0, 0), np.nan
    ),
    "/transfer/standard_error: 1 of 5 rows are negative or not finite, the first is row 4": lambda file: changed(
        file, "transfer/standard_error", (4, 0), np.nan
    ),
    "/transfer/standard_error: 1 of 5 rows are negative or not finite, the first is row 2": lambda file: changed(
        file, "transfer/standard_error", (2, 1), np.inf
    ),
    "/transfer/coefficients: 1 of 5 vertices have NaN or infinite values in float32.* vertex 3": lambda file: put(
        file, "transfer/coefficients", file["transfer/coefficients"][...] + BEYOND_FLOAT32
    ),
    "/bins/directions: 6 of 6 rows are not the centres of 2 rings of 3 sectors": lambda file: changed(
        file, "bins/directions", slice(None), 0.0
    ),
    "/bins/directions: 6 of 6 rows are not the centres of 3 rings of 2 sectors": lambda file: file["bins"].attrs.update(
        rings=3, sectors=2
    ),
    "/mesh/positions: 1 of 5 rows are not finite": lambda file: changed(file, "mesh/positions", (1, 0), np.inf),
    "/mesh/normals: 1 of 5 rows are not of length 1": lambda file: changed(file, "mesh/normals", 3, 0),
    "/mesh/tangents: .* not perpendicular": lambda file: changed(file, "mesh/tangents", 3, file["mesh/normals"][3]),
    "/mesh/faces: 1 of 5 rows are out of the range of vertices": lambda file: changed(file, "mesh/faces", (2, 1), 5),
    "origin is not a finite point": lambda file: file["mesh/positions"].attrs.__setitem__("origin", [0.0, np.nan, 0]),
    "/provenance/json is not a JSON object": lambda file: put(file, "provenance/json", "[1, 2"),
    "/provenance/json is not a JSON object .NaN": lambda file: put(file, "provenance/json", '{"seed": NaN}'),
    "/provenance/json: eta is 'x'; expected an index of refraction": lambda file: put(
        file, "provenance/json", '{"eta": "x"}'
    ),
    "/provenance/json: roughness is -3; expected a GGX alpha": lambda file: put(
        file, "provenance/json", '{"roughness": -3}'
    ),
    "/provenance/json: model.roughness is 'x'": lambda file: put(
        file, "provenance/json", '{"model": {"roughness": "x"}}'
    ),
    "/provenance/json: model is 5; expected a table": lambda file: put(file, "provenance/json", '{"model": 5}'),
    "/provenance/json: settings is .1.; expected a table": lambda file: put(
        file, "provenance/json", '{"settings": [1]}'
    ),
    r"/provenance/json: settings.for_eye is .1.; expected a point": lambda file: put(
        file, "provenance/json", '{"settings": {"for_eye": [1]}}'
    ),
    "/provenance/json: seconds is '12'; expected a number": lambda file: put(
        file, "provenance/json", '{"seconds": "12"}'
    ),
    "/provenance/json: estimated_relative_rmse.total is -1; expected an error": lambda file: put(
        file, "provenance/json", '{"estimated_relative_rmse": {"total": -1}}'
    ),
    "/provenance/json: compression.added_relative_rmse is 'x'; expected an error": lambda file: put(
        file, "provenance/json", '{"compression": {"added_relative_rmse": "x"}}'
    ),
    "/mesh: the attribute flat_shaded is 2; expected 0 or 1": lambda file: file["mesh"].attrs.__setitem__(
        "flat_shaded", 2
    ),
    "network_error is 0.1; expected three numbers": lambda file: file.attrs.__setitem__("network_error", 0.1),
    "network_error is .0.1, 0.3, 0.2.; expected three numbers": lambda file: file.attrs.__setitem__(
        "network_error", [0.1, 0.3, 0.2]
    ),
    "network_error is .nan, nan, nan.; expected three numbers": lambda file: file.attrs.__setitem__(
        "network_error", np.full(3, np.nan)
    ),
    "left_out is not a JSON list of tables": lambda file: file.attrs.__setitem__("left_out", "[1]"),
    r"format = 'prtbake', found an array of shape \[2\]": lambda file: file.attrs.__setitem__(
        "format", [b"prtbake", b"x"]
    ),
    r"format_version an array of shape \[2\]": lambda file: file.attrs.__setitem__("format_version", [1, 0]),
    r"attribute up is an array of shape \[2\]; expected 'y' or 'z'": lambda file: file.attrs.__setitem__(
        "up", [b"y", b"z"]
    ),
    r"attribute complete is an array of shape \[2\]": lambda file: file.attrs.__setitem__("complete", [1, 1]),
    r"attribute unit is an array of shape \[2\]": lambda file: file.attrs.__setitem__("unit", [b"m", b"m"]),
    r"rings is an array of shape \[2\]": lambda file: file["bins"].attrs.__setitem__("rings", [2, 2]),
    r"quantity is an array of shape \[2\]": lambda file: file["transfer"].attrs.__setitem__("quantity", [b"x", b"y"]),
    "/selftest/vertex is missing": lambda file: file.__delitem__("selftest/vertex"),
    "/selftest/vertex: 1 of 2 rows": lambda file: changed(file, "selftest/vertex", 1, 9),
    "quantity is 'colour'": lambda file: file["transfer"].attrs.__setitem__("quantity", "colour"),
    "compact": lambda file: file.move("transfer", "transfer_compact"),
    "/transfer/error_apart is missing": lambda file: file.__delitem__("transfer/error_apart"),
    r"/transfer/error_channels has shape \[3, 3\]; expected \[N = 2, 3 or 1\]": lambda file: put(
        file, "transfer/error_channels", np.ones((3, 3), "f2")
    ),
    "/transfer/error_covariance has rows of 9; expected 10": lambda file: put(
        file, "transfer/error_covariance", np.ones((2, 9), "f2")
    ),
    "/transfer/error_covariance: 1 of 2 rows are invalid, the first is row 1": lambda file: changed(
        file, "transfer/error_covariance", (1, 0), 9.0
    ),
    "/transfer/error_channels: 2 of 2 rows are invalid": lambda file: changed(
        file, "transfer/error_channels", slice(None), [-1.0, 2.0, 2.0]
    ),
    "/transfer/error_apart: 1 of 2 rows are invalid, the first is row 0": lambda file: changed(
        file, "transfer/error_apart", (0, 1), np.nan
    ),
    "/transfer/error_row selects rows .* expected less than 2": lambda file: changed(file, "transfer/error_row", 3, 2),
    "/transfer/error_covariance has 2 rows; expected 1 or 5": lambda file: file.__delitem__("transfer/error_row"),
}


@pytest.mark.parametrize("sentence", CHANGES)
def test_every_fault_is_named(tmp_path, sentence):
    selftest = {
        "light": np.ones((4, 3)),
        "vertex": np.arange(2),
        "outgoing": np.eye(3)[:2],
        "radiance": np.ones((2, 3)),
    }
    write_asset(make_asset(selftest=selftest, error_covariance=make_covariance(5, 4, 3, 2)), tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        CHANGES[sentence](file)
    assert_refused(tmp_path / "a.h5", sentence)


def test_attributes_of_one_value_in_an_array_and_bytes_are_read(tmp_path):
    write_asset(asset := make_asset(), tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        nodes = [file, file["basis"], file["bins"], file["transfer"]]
        for node, name in [(each, name) for each in nodes for name in each.attrs]:
            value = node.attrs[name]
            node.attrs[name] = [value.encode() if isinstance(value, str) else value]
    assert check_asset(tmp_path / "a.h5") == []
    again = read_asset(tmp_path / "a.h5")
    for name in ("up", "unit", "quantity", "folded_in", "rings", "sectors", "degree", "complete", "left_out"):
        assert getattr(again, name) == getattr(asset, name)
        assert type(getattr(again, name)) is type(getattr(asset, name))


@pytest.mark.parametrize("kind", ["f8", "g", ">f4", ">f2"])
@pytest.mark.parametrize("filters", [{}, {"compression": 4, "shuffle": True}])
def test_other_types_of_coefficients_are_read_and_sound(tmp_path, kind, filters):
    asset = make_asset(storage="float16")
    write_asset(asset, tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        values = file["transfer/coefficients"][...].astype(kind)
        del file["transfer/coefficients"]
        file.create_dataset("transfer/coefficients", data=values, chunks=(2, *values.shape[1:]), **filters)
    assert check_asset(tmp_path / "a.h5") == []
    np.testing.assert_array_equal(read_asset(tmp_path / "a.h5").coefficients, asset.coefficients)


def test_nan_in_unbaked_vertices_is_no_fault(tmp_path):
    write_asset(make_asset(valid=[1, 1, 0, 1, 1]), tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        changed(file, "transfer/coefficients", 2, np.nan)
        changed(file, "transfer/standard_error", 2, np.nan)
    assert check_asset(tmp_path / "a.h5") == []


def test_a_newer_minor_version_is_accepted(tmp_path):
    write_asset(make_asset(), tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        file.attrs["format_version"] = "1.7"
    assert check_asset(tmp_path / "a.h5") == []


def test_a_writer_left_without_finish_keeps_the_old_asset(tmp_path):
    path = tmp_path / "a.h5"
    path.write_text("old")
    asset = make_asset()
    with AssetWriter(path, asset) as writer:
        writer.write_block(0, asset.coefficients, asset.standard_error)
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.h5"]


PROGRAM = """
import os, resource, signal, sys
sys.path.insert(0, sys.argv[2])
from tests.formats.asset.test_asset import make_asset
from formats.asset import AssetWriter
from formats.errors import StorageError
asset = make_asset(400, 4, 16, 2)
writer = AssetWriter(sys.argv[1], asset, storage=sys.argv[4])
if sys.argv[3] == "full":
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, resource.RLIM_INFINITY))
try:
    for start in range(0, 400, 40):
        if sys.argv[3] == "kill" and start == 200:
            os.kill(os.getpid(), signal.SIGKILL)
        writer.write_block(start, asset.coefficients[start:start + 40], asset.standard_error[start:start + 40])
    writer.finish({})
except StorageError as fault:
    print(fault)
"""


def test_ctrl_c_during_a_write_keeps_the_file_consistent(tmp_path, monkeypatch):
    asset = make_asset()
    write = Sink.write
    monkeypatch.setattr(Sink, "write", lambda *arguments: (signal.raise_signal(signal.SIGINT), write(*arguments))[1])
    with pytest.raises(KeyboardInterrupt):
        AssetWriter(tmp_path / "unopened.h5", asset)
    monkeypatch.undo()
    with AssetWriter(tmp_path / "a.h5", asset, storage="float32") as writer:
        writer.write_block(0, asset.coefficients[:2], asset.standard_error[:2])
        monkeypatch.setattr(
            Sink, "write", lambda *arguments: (signal.raise_signal(signal.SIGINT), write(*arguments))[1]
        )
        with pytest.raises(KeyboardInterrupt):
            writer.finish({}, complete=False)
    assert read_asset(tmp_path / "a.h5").valid.tolist() == [True, True, False, False, False]


def run(path: Path, end: str, storage: str) -> subprocess.CompletedProcess[str]:
    arguments = [sys.executable, "-c", PROGRAM, str(path), str(ROOT), end, storage]
    return subprocess.run(arguments, check=False, capture_output=True, text=True)


@pytest.mark.parametrize("storage", ["float16", "float32"])
def test_a_full_disk_keeps_the_old_asset(tmp_path, storage):
    path = tmp_path / "a.h5"
    path.write_text("old")
    ended = run(path, "full", storage)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert ended.stdout.startswith(f"{path}: cannot be written: ")
    assert ended.stdout.count("\n") == 1
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.h5"]


def test_a_killed_writer_keeps_the_old_asset(tmp_path):
    path = tmp_path / "a.h5"
    write_asset(make_asset(), path)
    before = path.read_bytes()
    assert run(path, "kill", "float32").returncode == -signal.SIGKILL
    assert path.read_bytes() == before
    assert check_asset(path) == []
