"""Strings in damaged HDF5 files: refused before the library crashes, loops for ever or reserves gigabytes."""

import struct
from pathlib import Path

import h5py
import numpy as np
import pytest

from formats import hdf5_strings
from formats.errors import AssetError
from formats.hdf5_file import attribute, first_fault, open_hdf5
from formats.hdf5_strings import DamagedDataError, read_string

HEAP = b"GCOL\x01\0\0\0"


@pytest.fixture
def strings(tmp_path: Path) -> Path:
    """A file with three strings as attributes, all in one heap."""
    with h5py.File(path := tmp_path / "strings.h5", "w") as file:
        file.attrs.update(format="prtbake", version="1.0", note="three")
    return path


def open_it(path: Path) -> None:
    open_hdf5(path, AssetError, "is not an asset", "bake it").close()


def assert_refused(path: Path, place: int, layout: str, *values: int) -> None:
    """The file is refused with these values at this place."""
    content = bytearray(path.read_bytes())
    struct.pack_into(layout, content, place, *values)
    path.write_bytes(content)
    with pytest.raises(AssetError, match=r"strings\.h5: is damaged.*copy or bake it again"):
        open_it(path)


@pytest.mark.parametrize("size", [2**64 - 16, 2**64 - 17, 2**64 - 23])
@pytest.mark.parametrize("string", [0, 1, 2])
def test_a_string_whose_length_wraps_to_nothing_is_refused(strings: Path, string: int, size: int) -> None:
    # Every object has 16 bytes of head and 8 of content: its size stands in the last 8 of the head.
    assert_refused(strings, strings.read_bytes().index(HEAP) + 16 + 24 * string + 8, "<Q", size)


@pytest.mark.parametrize("size", [2**64 - 16, 2**64 - 17, 2**64 - 23])
def test_a_string_that_nothing_refers_to_and_that_wraps_to_nothing_is_refused(strings: Path, size: int) -> None:
    assert_refused(strings, strings.read_bytes().index(HEAP) + 16 + 3 * 24, "<HHIQ", 4, 0, 0, size)


@pytest.mark.parametrize("size", [0, 15, 16])
def test_a_heap_without_strings_is_refused(strings: Path, size: int) -> None:
    assert_refused(strings, strings.read_bytes().index(HEAP) + 8, "<Q", size)


def test_a_free_rest_of_no_size_is_refused(strings: Path) -> None:
    assert_refused(strings, strings.read_bytes().index(HEAP) + 16, "<HHIQ", 0, 0, 0, 0)


@pytest.mark.parametrize("unused", [0, 255])
@pytest.mark.parametrize("length", [1, 9, 2**31 - 1, 2**32 - 1])
@pytest.mark.parametrize("string", [0, 1, 2])
def test_a_string_of_another_length_than_its_reference_is_refused(
    strings: Path, string: int, length: int, unused: int
) -> None:
    content = strings.read_bytes()
    reference = content.index(struct.pack("<QI", content.index(HEAP), 1 + string))
    assert_refused(strings, reference - 5, "<BI", unused, length)


@pytest.mark.parametrize("libver", ["earliest", "v110", "latest"])
def test_a_heap_whose_string_is_longer_than_its_reference_is_refused(tmp_path: Path, libver: str) -> None:
    with h5py.File(path := tmp_path / "strings.h5", "w", libver=libver) as file:
        file.attrs["note"] = "words"
    assert_refused(path, path.read_bytes().index(HEAP) + 16 + 8, "<Q", 6)


def test_a_missing_string_counts_as_empty(strings: Path) -> None:
    """C programs store a null pointer in this way."""
    content = bytearray(strings.read_bytes())
    reference = content.index(struct.pack("<QI", content.index(HEAP), 3)) - 4
    content[reference : reference + 16] = bytes(16)
    strings.write_bytes(content)
    with open_hdf5(strings, AssetError, "is not an asset", "bake it") as file:
        assert attribute(file, "note") == ""


@pytest.mark.parametrize("address", [0, 1, 2**32, 2**64 - 1])
def test_a_reference_to_no_heap_is_refused(strings: Path, address: int) -> None:
    content = strings.read_bytes()
    assert_refused(strings, content.index(struct.pack("<QI", content.index(HEAP), 1)), "<Q", address)


@pytest.mark.parametrize("libver", ["earliest", "v110", "latest"])
def test_strings_of_other_programs_open(tmp_path: Path, libver: str) -> None:
    with h5py.File(path := tmp_path / "strings.h5", "w", libver=libver) as file:
        file.attrs.update(long="x" * 5000, empty="", umlaut="ä", bytes=np.bytes_("fixed"), two=["a", "b"])
        file.attrs["ä"] = "a name beyond ASCII"
        file.attrs.create("ASCII", "text", dtype=h5py.string_dtype("ascii"))
        file.create_dataset("picture of a heap", data=list(HEAP))
        file["text"] = "words"
    with open_hdf5(path, AssetError, "is not an asset", "bake it") as file:
        assert [attribute(file, name) for name in ("umlaut", "bytes", "ä", "ASCII")] == [
            "ä",
            "fixed",
            "a name beyond ASCII",
            "text",
        ]
        assert read_string(file["text"]) == b"words"


@pytest.fixture
def lost_names(tmp_path: Path) -> tuple[Path, int, list[int]]:
    """A file whose group lost two names, the place of its names, and in it the first two blocks that are free."""
    with h5py.File(path := tmp_path / "strings.h5", "w") as file:
        for name in ("a long name", "a name between", "another long name", "the last name"):
            file["group/" + name] = 0
    with h5py.File(path, "r+") as file:
        del file["group/a long name"], file["group/another long name"]
    content = path.read_bytes()
    first, names = struct.unpack_from("<QQ", content, content.rindex(b"HEAP\0\0\0\0") + 16)
    (second,) = struct.unpack_from("<Q", content, names + first)
    return path, names, [first, second]


def test_a_group_that_lost_names_opens(lost_names: tuple[Path, int, list[int]]) -> None:
    path, _, (first, second) = lost_names
    assert first != second != 1
    open_it(path)


def test_a_group_whose_names_leave_no_block_free_opens(lost_names: tuple[Path, int, list[int]]) -> None:
    path, names, _ = lost_names
    content = bytearray(path.read_bytes())
    struct.pack_into("<Q", content, content.rindex(b"HEAP\0\0\0\0") + 16, 1)
    content[names : names + 16] = bytes(16)
    path.write_bytes(content)
    open_it(path)


@pytest.mark.parametrize("place", [2**20, 2**64 - 2])
def test_a_free_block_outside_the_file_is_left_to_the_library(
    lost_names: tuple[Path, int, list[int]], place: int
) -> None:
    path, names, blocks = lost_names
    content = bytearray(path.read_bytes())
    struct.pack_into("<Q", content, names + blocks[1], place)
    path.write_bytes(content)
    open_it(path)
    with h5py.File(path) as file, pytest.raises((RuntimeError, KeyError), match=r"free list|address overflow"):
        file["group/the last name"]


@pytest.mark.parametrize(("block", "follower"), [(0, 0), (1, 0), (1, 1)])
def test_free_blocks_among_names_that_never_end_are_refused(
    lost_names: tuple[Path, int, list[int]], block: int, follower: int
) -> None:
    path, names, blocks = lost_names
    assert_refused(path, names + blocks[block], "<Q", blocks[follower])


@pytest.mark.parametrize(("offset", "value"), [(0, 6), (4, 2**31), (4, 0), (12, 2)])
def test_a_dataset_whose_string_is_not_there_is_refused(tmp_path: Path, offset: int, value: int) -> None:
    with h5py.File(path := tmp_path / "strings.h5", "w") as file:
        file["text"] = "words"
        place = file["text"].id.get_offset()
    content = bytearray(path.read_bytes())
    struct.pack_into("<I", content, place + offset, value)
    path.write_bytes(content)
    with h5py.File(path) as file, pytest.raises(DamagedDataError, match="/text: the text cannot be read"):
        read_string(file["text"])


def test_strings_in_the_head_of_a_dataset_are_read(tmp_path: Path) -> None:
    compact = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    compact.set_layout(h5py.h5d.COMPACT)
    with h5py.File(tmp_path / "compact.h5", "w") as file:
        text = h5py.h5t.py_create(h5py.string_dtype(), logical=True)
        h5py.h5d.create(file.id, b"text", text, h5py.h5s.create(h5py.h5s.SCALAR), compact)
        file["text"][()] = "words"
        assert read_string(file["text"]) == b"words"


@pytest.mark.parametrize("size", [1, 15])
def test_references_of_another_size_are_refused(strings: Path, size: int) -> None:
    content = bytearray(strings.read_bytes())
    content[content.index(b"\x19\x01\x01\0\x10\0\0\0", content.index(b"format\0")) + 4] = size
    strings.write_bytes(content)
    with h5py.File(strings) as file, pytest.raises(DamagedDataError, match="attribute format"):
        attribute(file, "format")


def test_attributes_and_datasets_of_lists_are_refused(strings: Path) -> None:
    with h5py.File(strings, "r+") as file:
        file.create_dataset("lists", (), h5py.vlen_dtype(np.int64))
    content = bytearray(strings.read_bytes())
    # A string is a list of the kind 1; HDF5 knows only lists of kind 0 and 1, and h5py crashes on others.
    content[content.index(b"\x19", content.index(b"format\0")) + 1] = 5
    strings.write_bytes(content)
    with h5py.File(strings) as file:
        with pytest.raises(DamagedDataError, match="/: the attribute format cannot be read"):
            attribute(file, "format")
        with pytest.raises(DamagedDataError, match="/lists: the text cannot be read"):
            read_string(file["lists"])


@pytest.mark.parametrize("length", [5, 2**32 - 1])
@pytest.mark.parametrize("size", [5, 2**64 - 16])
def test_strings_at_the_end_of_a_file_are_searched_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, length: int, size: int
) -> None:
    with h5py.File(path := tmp_path / "long.h5", "w") as file:
        file["numbers"] = np.arange(10**5)
        file.create_group("end").attrs["note"] = "words"
    content = bytearray(path.read_bytes())
    heap = content.index(HEAP)
    reference = content.index(struct.pack("<IQI", 5, heap, 1))
    searched = len(content) - min(heap, reference) + 40  # the attribute's type and shape come before the reference
    monkeypatch.setattr(hdf5_strings, "_SEARCHED", searched)
    assert searched < len(content) // 2
    struct.pack_into("<Q", content, heap + 24, size)
    struct.pack_into("<I", content, reference, length)
    path.write_bytes(content)
    if (length, size) == (5, 5):
        open_it(path)
        return
    with pytest.raises(AssetError, match="is damaged"):
        open_it(path)


def test_a_fault_without_a_remedy_gets_one() -> None:
    assert first_fault(["/mesh is missing"], "bake it again") == "/mesh is missing; bake it again"
    assert first_fault(["x; make y", "z"], "bake it again") == "x; make y (and 1 more faults)"
