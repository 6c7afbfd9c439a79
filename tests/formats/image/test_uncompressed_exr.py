"""Uncompressed OpenEXR in blocks of rows equals the complete image bit for bit; damaged files are refused."""

from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from formats.errors import ImageError
from formats.image import read_image
from formats.image.rows import open_image

Channels = dict[str, np.ndarray]


def noise(height: int, width: int, kind: str = "float16") -> np.ndarray:
    return np.random.default_rng(1).normal(size=(height, width)).astype(kind)


def write(path: Path, channels: Channels, **header: object) -> None:
    kinds = {"compression": OpenEXR.NO_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File({**kinds, **header}, channels).write(str(path))


def colours(height: int, width: int, kind: str = "float16") -> Channels:
    return {name: noise(height, 3 * width, kind)[:, i::3].copy() for i, name in enumerate("RGB")}


def assert_same(path: Path) -> None:
    opened = open_image(path)
    assert all(block.flags.aligned for _, block in opened.blocks())
    np.testing.assert_array_equal(opened.read(), read_image(path))


@pytest.mark.parametrize("kind", ["float16", "float32"])
@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (33, 7), (64, 4096)])
def test_images_of_any_size(tmp_path: Path, kind: str, shape: tuple[int, int]) -> None:
    write(tmp_path / "a.exr", colours(*shape, kind))
    assert_same(tmp_path / "a.exr")
    blocks = [block for _, block in open_image(tmp_path / "a.exr").blocks()]
    assert {block.dtype for block in blocks} == {np.dtype(kind)}


def test_other_channels_are_ignored_and_luminance_is_grey(tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    for others in ({"A": noise(40, 9)}, {"Z": noise(40, 9, "float32")}, {"id": np.ones((40, 9), np.uint32)}):
        write(path, {**colours(40, 9), **others})
        assert_same(path)
    write(path, {f"diffuse.{name}": pixels for name, pixels in colours(40, 9, "float32").items()})
    assert_same(path)
    write(path, {"Y": noise(40, 9)})
    assert_same(path)


@pytest.mark.parametrize("rows", [(-40, 39), (5, 84), (60, 139), (200, 279)])
def test_stored_rows_above_within_and_below_the_image(tmp_path: Path, rows: tuple[int, int]) -> None:
    """Rows without stored pixels are black."""
    corners = {
        "dataWindow": (np.array([3, rows[0]], np.int32), np.array([22, rows[1]], np.int32)),
        "displayWindow": (np.array([3, 0], np.int32), np.array([22, 99], np.int32)),
    }
    write(tmp_path / "a.exr", colours(80, 20), **corners)
    found = open_image(tmp_path / "a.exr").read()
    if rows[0] < 100:
        np.testing.assert_array_equal(found, read_image(tmp_path / "a.exr"))
    assert found.any() == (rows[0] < 100)


def test_channels_rows_and_columns_in_every_order(tmp_path: Path) -> None:
    """Channels between the colours, different types, rows from the bottom, columns outside the image."""
    path = tmp_path / "a.exr"
    write(path, {**colours(40, 9), "Fog": noise(40, 9)})
    assert_same(path)
    write(path, {**colours(40, 9), "R": noise(40, 9, "float32")})
    assert_same(path)
    write(path, {**colours(40, 9, "float32"), "A": noise(40, 9)})
    assert_same(path)
    write(path, colours(40, 9), lineOrder=OpenEXR.DECREASING_Y)
    assert_same(path)
    wide = (np.array([0, 0], np.int32), np.array([9, 39], np.int32))
    write(path, colours(40, 9), displayWindow=wide)
    assert_same(path)


@pytest.mark.parametrize(("head", "value"), [(0, 41), (4, 1)])
def test_misplaced_rows_are_refused(tmp_path: Path, head: int, value: int) -> None:
    write(tmp_path / "a.exr", colours(100, 9))
    content = bytearray((tmp_path / "a.exr").read_bytes())
    row = len(content) - (8 + 2 * 3 * 9) * 60
    assert content[row : row + 4] == (40).to_bytes(4, "little")
    content[row + head : row + head + 4] = value.to_bytes(4, "little")
    (tmp_path / "a.exr").write_bytes(content)
    with pytest.raises(ImageError, match="truncated or damaged in row 32 of 100"):
        open_image(tmp_path / "a.exr").read()


def test_a_truncated_file_is_refused_wherever_it_ends(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    write(tmp_path / "a.exr", colours(100, 9))
    content = (tmp_path / "a.exr").read_bytes()
    for length in (*range(10, 1400, 97), len(content) - 1):
        (tmp_path / "cut.exr").write_bytes(content[:length])
        with pytest.raises(ImageError, match=r"cut\.exr: "):
            open_image(tmp_path / "cut.exr").read()
    assert capfd.readouterr() == ("", "")


def test_a_file_truncated_during_the_read_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    write(path, colours(100, 9))
    blocks = open_image(path).blocks()
    next(blocks)
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(ImageError, match="truncated or damaged in row 32 of 100"):
        next(blocks)
