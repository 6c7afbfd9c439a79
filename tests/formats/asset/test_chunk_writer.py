"""The chunk writer writes the bytes that HDF5 writes."""

from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from formats.asset.chunk_writer import LEVEL, MAX_OPEN, ChunkWriter

ROWS, VERTICES = 3, 41


def dataset(file: h5py.File, name: str, dtype: str = "<f2") -> h5py.Dataset:
    shape, chunks = (VERTICES, 4, 5), (ROWS, 4, 5)
    return file.create_dataset(
        name, shape, dtype, chunks=chunks, compression="gzip", compression_opts=LEVEL, shuffle=True
    )


def numbers(seed: int, dtype: str = "<f2") -> NDArray[np.floating]:
    return np.random.default_rng(seed).normal(size=(VERTICES, 4, 5)).round(1).astype(dtype)


@pytest.mark.parametrize("dtype", ["<f2", "<f4"])
def test_chunks_equal_those_of_hdf5_byte_for_byte(tmp_path: Path, dtype: str) -> None:
    values = numbers(1, dtype)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        expected, own = dataset(file, "expected", dtype), dataset(file, "own", dtype)
        expected[:] = values
        writer = ChunkWriter(own)
        writer.write(slice(0, VERTICES), values)
        writer.finish()
        file.flush()
        assert expected.id.get_num_chunks() == own.id.get_num_chunks() == -(-VERTICES // ROWS)
        for first in range(0, VERTICES, ROWS):
            assert expected.id.read_direct_chunk((first, 0, 0)) == own.id.read_direct_chunk((first, 0, 0))


@settings(max_examples=60, deadline=None)
@given(
    spans=st.lists(st.tuples(st.integers(0, VERTICES - 1), st.integers(1, 12)), min_size=1, max_size=40),
    seed=st.integers(0, 2**16),
)
def test_rows_are_accepted_in_any_order_twice_or_never(
    tmp_path_factory: pytest.TempPathFactory, spans: list[tuple[int, int]], seed: int
) -> None:
    values, expected = numbers(seed), np.zeros((VERTICES, 4, 5), "<f2")
    path = tmp_path_factory.mktemp("rows") / "a.h5"
    with h5py.File(path, "w") as file:
        writer = ChunkWriter(dataset(file, "a"))
        for turn, (first, count) in enumerate(spans):
            rows = slice(first, min(first + count, VERTICES))
            given_rows = values[rows] * (turn + 1)
            expected[rows] = given_rows
            writer.write(rows, given_rows)
            given_rows[:] = -1.0
        writer.finish()
    with h5py.File(path) as file:
        np.testing.assert_array_equal(file["a"][()], expected)


def test_incomplete_chunks_do_not_pile_up(tmp_path: Path) -> None:
    values = numbers(2)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        writer = ChunkWriter(file.create_dataset("a", (900, 2), "<f2", chunks=(3, 2), compression="gzip", shuffle=True))
        for vertex in range(0, 900, 3):
            writer.write(slice(vertex, vertex + 1), values[vertex % VERTICES, :1, :2])
            assert len(writer._open) <= MAX_OPEN
        writer.finish()
    with h5py.File(tmp_path / "a.h5") as file:
        np.testing.assert_array_equal(file["a"][::3], values[np.arange(0, 900, 3) % VERTICES, 0, :2])
        assert not file["a"][1::3].any()
