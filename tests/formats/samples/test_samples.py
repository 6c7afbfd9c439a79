"""Sample files: every valid one survives a round trip, damaged and foreign files are refused."""

import os
import re
import signal
import struct
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from formats.asset import write_asset
from formats.errors import SamplesError, StorageError
from formats.hdf5_sink import Sink
from formats.samples import SamplesHead, check_samples, is_samples, read_samples
from formats.samples.writer import SamplesWriter
from tests.formats.asset.test_asset import make_asset

NAMES = ("keys", "positions", "outgoing", "incident", "mean", "standard_error")


def unit(shape, generator):
    d = generator.normal(size=(*shape, 3))
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def block(count, directions, seed=0):
    generator = np.random.default_rng(seed)
    return {
        "keys": generator.integers(0, 2**64, count, np.uint64),
        "positions": generator.normal(size=(count, 3)) * 1e3,
        "outgoing": unit((count,), generator),
        "incident": unit((count, directions), generator),
        "mean": generator.exponential(size=(count, directions, 3)),
        "standard_error": generator.exponential(size=(count, directions, 3)),
    }


def head(directions, **more):
    given = {"scene": "s.toml", "scene_hash": "ab", "unit": "mm", "seed": 2**63 - 1, "walks": 4}
    return SamplesHead(**{**given, **more}, directions=directions, settings={"connections": 2})


def write(path, blocks, directions=3, complete=True):
    with SamplesWriter(path, head(directions)) as writer:
        for each in blocks:
            writer.append(**each)
        writer.finish(complete)


@settings(max_examples=20, deadline=None)
@given(
    counts=st.lists(st.integers(0, 40), min_size=1, max_size=4).filter(any),
    directions=st.integers(1, 6),
    seed=st.integers(0, 1000),
    complete=st.booleans(),
)
def test_samples_survive_write_and_read(tmp_path_factory, counts, directions, seed, complete):
    path = tmp_path_factory.mktemp("s") / "s.h5"
    blocks = [block(count, directions, seed + k) for k, count in enumerate(counts)]
    write(path, blocks, directions, complete)
    found = read_samples(path)
    assert (found.head, found.complete) == (head(directions), complete)
    for name in NAMES:
        stored = getattr(found, name)
        expected = np.concatenate([each[name] for each in blocks])
        np.testing.assert_array_equal(stored, expected.astype(stored.dtype))
    assert (found.keys.dtype, found.positions.dtype, found.mean.dtype) == (np.uint64, np.float64, np.float32)
    assert check_samples(path) == []
    assert is_samples(path)


def assert_refused(path, sentence):
    with pytest.raises(SamplesError, match=sentence) as caught:
        read_samples(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert re.search(sentence, message.removeprefix(f"{path}: "))  # the folder is named after the test
    assert "\n" not in message
    faults = check_samples(path)
    assert all(fault.startswith(f"{path}: ") for fault in faults)
    assert any(re.search(sentence, fault.removeprefix(f"{path}: ")) for fault in faults)


def test_a_truncated_file_is_refused(tmp_path):
    write(tmp_path / "a.h5", [block(300, 3)])
    content = (tmp_path / "a.h5").read_bytes()
    for tenth in range(10):
        (tmp_path / "cut.h5").write_bytes(content[: len(content) * tenth // 10])
        assert_refused(tmp_path / "cut.h5", "truncated" if tenth else "empty")


@pytest.fixture(scope="module")
def intact_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("s") / "a.h5"
    write(path, [block(60, 2)], directions=2)
    return path


@settings(max_examples=30, deadline=None)
@given(place=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
def test_a_flipped_bit_is_refused_or_harmless(tmp_path_factory, intact_file, place, bit):
    """Values that are read are never wrong, because everything has a checksum."""
    folder = tmp_path_factory.mktemp("s")
    content = bytearray(intact_file.read_bytes())
    content[int(place * len(content))] ^= 1 << bit
    (folder / "b.h5").write_bytes(content)
    intact = read_samples(intact_file)
    if check_samples(folder / "b.h5"):
        assert_refused(folder / "b.h5", ".")
        return
    found = read_samples(folder / "b.h5")
    for name in NAMES:
        np.testing.assert_array_equal(getattr(found, name), getattr(intact, name))


def test_other_files_are_refused(tmp_path):
    (tmp_path / "a.h5").write_text("v 0 0 0\n")
    assert_refused(tmp_path / "a.h5", "expected an HDF5 file")
    assert not is_samples(tmp_path / "a.h5")
    write_asset(make_asset(), tmp_path / "b.h5")
    assert_refused(tmp_path / "b.h5", "is not a sample file: .* found 'prtbake'")
    assert not is_samples(tmp_path / "b.h5")
    with pytest.raises(StorageError, match="no such file"):
        read_samples(tmp_path / "missing.h5")


def test_a_file_whose_strings_are_damaged_is_no_sample_file(tmp_path):
    """Reading the attribute would take for ever."""
    with h5py.File(path := tmp_path / "a.h5", "w") as file:
        file.attrs["format"] = "words"
    endless = struct.pack("<Q", 2**64 - 16) + b"words"
    path.write_bytes(path.read_bytes().replace(struct.pack("<Q", 5) + b"words", endless))
    assert not is_samples(path)


def put(file, name, values):
    del file[name]
    file.create_dataset(name, data=values)


def changed(file, name, place, value):
    values = file[name][...]
    values[place] = value
    put(file, name, values)


CHANGES = {
    "has format_version 2.0": lambda file: file.attrs.__setitem__("format_version", "2.0"),
    "the attribute source has no valid scene": lambda file: file.attrs.__delitem__("source"),
    "the attribute source has no valid scene_hash": lambda file: file.attrs.__setitem__("source", '{"scene": "a"}'),
    "the attribute seed is missing; expected an integer": lambda file: file.attrs.__delitem__("seed"),
    "the attribute walks is many; expected an integer": lambda file: file.attrs.__setitem__("walks", "many"),
    "source has no valid scene\\b": lambda file: file.attrs.__setitem__("source", "[1"),
    "/estimates/mean is missing": lambda file: file.__delitem__("estimates/mean"),
    "/queries/positions has type float32": lambda file: put(file, "queries/positions", np.zeros((5, 3), "f4")),
    r"/estimates/mean has shape \[5, 2, 3\]; expected \[N = 5, D = 3, 3\]": lambda file: put(
        file, "estimates/mean", np.zeros((5, 2, 3), "f4")
    ),
    r"/queries/outgoing has shape \[4, 3\]": lambda file: put(file, "queries/outgoing", np.zeros((4, 3), "f4")),
    "mean: 1 of 5 queries are not finite, the first is query 2": lambda file: changed(
        file, "estimates/mean", (2, 1, 0), np.nan
    ),
    "positions: 1 of 5 queries are not finite": lambda file: changed(file, "queries/positions", (4, 0), np.inf),
    "incident: 1 of 5 queries are not of length 1": lambda file: changed(file, "queries/incident", (3, 0), 2.0),
    "standard_error: 1 of 5 queries are negative": lambda file: changed(
        file, "estimates/standard_error", (1, 1, 1), -1.0
    ),
}


@pytest.mark.parametrize("sentence", CHANGES)
def test_every_fault_is_named(tmp_path, sentence):
    write(tmp_path / "a.h5", [block(5, 3)])
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        CHANGES[sentence](file)
    assert_refused(tmp_path / "a.h5", sentence)


def test_a_file_without_queries_is_refused(tmp_path):
    write(tmp_path / "a.h5", [])
    assert_refused(tmp_path / "a.h5", "has no queries")


def test_blocks_of_wrong_shape_are_refused(tmp_path):
    with SamplesWriter(tmp_path / "a.h5", head(3)) as writer:
        with pytest.raises(SamplesError, match=r"incident has shape \[4, 2, 3\]; expected \[4, 3, 3\]"):
            writer.append(**block(4, 2))
        with pytest.raises(SamplesError, match="standard_error has values that are not finite"):
            writer.append(**{**block(4, 3), "standard_error": np.full((4, 3, 3), np.nan)})
        writer.append(**block(4, 3))
        writer.finish()
    with pytest.raises(SamplesError, match="the writer is closed"):
        writer.append(**block(4, 3))
    assert len(read_samples(tmp_path / "a.h5").keys) == 4


@pytest.mark.parametrize(("name", "value"), [("mean", 1e39), ("incident", -np.inf), ("keys", np.nan)])
def test_values_that_the_file_cannot_hold_are_refused(tmp_path: Path, name: str, value: float) -> None:
    numbers = block(4, 3)
    numbers[name] = np.full(numbers[name].shape, value)
    with SamplesWriter(tmp_path / "a.h5", head(3)) as writer:
        with pytest.raises(SamplesError, match=f"{name} has values that are not finite"):
            writer.append(**numbers)
        assert writer.count == 0


def test_a_writer_left_without_finish_keeps_the_old_file(tmp_path):
    path = tmp_path / "a.h5"
    path.write_text("old")
    with SamplesWriter(path, head(3)) as writer:
        writer.append(**block(4, 3))
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.h5"]


def test_a_full_disk_keeps_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.h5"
    path.write_text("old")
    write_to_disk = Sink.write

    def full(sink, content):
        if sink._end > 20_000:
            sink.error = sink.error or OSError(28, "No space left on device")
        return write_to_disk(sink, content)

    monkeypatch.setattr(Sink, "write", full)
    with pytest.raises(StorageError, match="the disk is full"):
        write(path, (block(2000, 3, seed) for seed in range(40)))
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.h5"]


def test_ctrl_c_during_a_write_keeps_the_file_consistent(tmp_path, monkeypatch):
    write_to_disk = Sink.write
    with SamplesWriter(tmp_path / "a.h5", head(3)) as writer:
        writer.append(**block(4, 3))
        monkeypatch.setattr(Sink, "write", lambda *args: (signal.raise_signal(signal.SIGINT), write_to_disk(*args))[1])
        with pytest.raises(KeyboardInterrupt):
            writer.finish(complete=False)
    found = read_samples(tmp_path / "a.h5")
    assert (len(found.keys), found.complete) == (4, False)
