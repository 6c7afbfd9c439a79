"""The chunk reader returns what HDF5 returns."""

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from formats.asset.chunk_reader import can_read_chunks, read_chunks

VERTICES, ROWS, SHAPE = 41, 3, (41, 4, 5)
OPTIONS: dict[str, Any] = {"chunks": (ROWS, 4, 5), "compression": "gzip", "shuffle": True}


def numbers() -> np.ndarray:
    return np.random.default_rng(4).normal(size=SHAPE)


@pytest.mark.parametrize("kind", ["<f2", "<f4"])
def test_all_rows_are_read_and_unwritten_chunks_stay_zero(tmp_path: Path, kind: str) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        dataset = file.create_dataset("a", SHAPE, kind, **OPTIONS)
        dataset[:7], dataset[30:] = numbers()[:7], numbers()[30:]
        file.flush()
        assert can_read_chunks(dataset)
        rows, seen = np.zeros(SHAPE, dataset.dtype), np.zeros(VERTICES)

        def check(part: slice) -> None:
            assert (rows[part] == dataset[part]).all()
            seen[part] += 1

        read_chunks(dataset, rows, check)
        np.testing.assert_array_equal(rows, dataset[...])
    assert seen.max() == 1
    assert seen[:7].all()
    assert seen[30:].all()
    assert not seen[9:30].any()


@pytest.mark.parametrize(
    "other_options",
    [{"compression": None, "shuffle": None}, {"shuffle": False}, {"fletcher32": True}, {"chunks": (3, 2, 5)}],
)
def test_datasets_with_other_options_are_left_to_hdf5(tmp_path: Path, other_options: dict[str, Any]) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        assert not can_read_chunks(file.create_dataset("a", SHAPE, "<f4", **OPTIONS | other_options))
        assert not can_read_chunks(file.create_dataset("big", SHAPE, ">f4", **OPTIONS))


@pytest.mark.parametrize("content", [b"nonsense", b"x\x9c\x03\x00\x00\x00\x00\x01"], ids=["damaged", "short"])
def test_a_damaged_chunk_raises_oserror(tmp_path: Path, content: bytes) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        dataset = file.create_dataset("a", SHAPE, "<f4", **OPTIONS)
        dataset[:] = numbers()
        dataset.id.write_direct_chunk((ROWS, 0, 0), content)
        with pytest.raises(OSError, match=f"^/a: rows {ROWS} to {2 * ROWS - 1} cannot be decompressed"):
            read_chunks(dataset, np.zeros(SHAPE, np.float32), lambda rows: None)
