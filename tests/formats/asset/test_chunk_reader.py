"""Chunks that are unpacked on several threads are what HDF5 reads itself."""

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from formats.asset.chunk_reader import read_chunks, unpacks

VERTICES, ROWS, SHAPE = 41, 3, (41, 4, 5)
PACKED: dict[str, Any] = {"chunks": (ROWS, 4, 5), "compression": "gzip", "shuffle": True}


def numbers() -> np.ndarray:
    return np.random.default_rng(4).normal(size=SHAPE)


@pytest.mark.parametrize("kind", ["<f2", "<f4"])
def test_all_rows_come_back_and_chunks_never_written_stay_zero(tmp_path: Path, kind: str) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        dataset = file.create_dataset("a", SHAPE, kind, **PACKED)
        dataset[:7], dataset[30:] = numbers()[:7], numbers()[30:]
        file.flush()
        assert unpacks(dataset)
        rows, seen = np.zeros(SHAPE, dataset.dtype), np.zeros(VERTICES)

        def look(part: slice) -> None:
            assert (rows[part] == dataset[part]).all()
            seen[part] += 1

        read_chunks(dataset, rows, look)
        np.testing.assert_array_equal(rows, dataset[...])
    assert seen.max() == 1
    assert seen[:7].all()
    assert seen[30:].all()
    assert not seen[9:30].any()


@pytest.mark.parametrize(
    "otherwise",
    [{"compression": None, "shuffle": None}, {"shuffle": False}, {"fletcher32": True}, {"chunks": (3, 2, 5)}],
)
def test_what_is_packed_in_another_way_is_left_to_hdf5(tmp_path: Path, otherwise: dict[str, Any]) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        assert not unpacks(file.create_dataset("a", SHAPE, "<f4", **PACKED | otherwise))
        assert not unpacks(file.create_dataset("big", SHAPE, ">f4", **PACKED))


@pytest.mark.parametrize("packed", [b"nonsense", b"x\x9c\x03\x00\x00\x00\x00\x01"], ids=["damaged", "short"])
def test_a_damaged_chunk_is_an_error_of_reading(tmp_path: Path, packed: bytes) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        dataset = file.create_dataset("a", SHAPE, "<f4", **PACKED)
        dataset[:] = numbers()
        dataset.id.write_direct_chunk((ROWS, 0, 0), packed)
        with pytest.raises(OSError, match=f"^/a: rows {ROWS} to {2 * ROWS - 1} cannot be unpacked"):
            read_chunks(dataset, np.zeros(SHAPE, np.float32), lambda rows: None)
