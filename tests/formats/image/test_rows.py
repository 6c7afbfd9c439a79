"""Images in blocks of rows equal complete images bit for bit, with the same errors and the memory of one block."""

import tracemalloc
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from formats.errors import ImageError, InputWarning, StorageError
from formats.image import read_image, read_layers, write_image
from formats.image.rows import ImageRows, open_image, rows_of

DRAW = np.random.default_rng(1)


def noise(height: int, width: int, channels: int = 3) -> np.ndarray:
    return DRAW.gamma(0.5, 4, (height, width, channels)).astype(np.float32)


def window(left: int, top: int, right: int, bottom: int) -> tuple[np.ndarray, np.ndarray]:
    return np.array([left, top], np.int32), np.array([right, bottom], np.int32)


def write_channels(path: Path, channels: dict[str, np.ndarray], **header: object) -> None:
    kinds = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    contiguous = {name: np.ascontiguousarray(pixels) for name, pixels in channels.items()}
    OpenEXR.File({**kinds, **header}, contiguous).write(str(path))


def assert_same(path: Path) -> ImageRows:
    opened, complete = open_image(path), read_image(path)
    assert (opened.height, opened.width) == complete.shape[:2]
    np.testing.assert_array_equal(opened.read(), complete)
    firsts = [(first, len(block)) for first, block in opened.blocks()]  # a second time
    assert all(first + rows == following for (first, rows), (following, _) in pairwise(firsts))
    return opened


@pytest.mark.parametrize("compression", ["NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "DWAA", "DWAB"])
@pytest.mark.parametrize("kind", ["float16", "float32"])
def test_openexr_of_every_compression(tmp_path: Path, compression: str, kind: str) -> None:
    write_channels(
        tmp_path / "a.exr",
        {"RGB": noise(301, 20).astype(kind)},
        compression=getattr(OpenEXR, f"{compression}_COMPRESSION"),
    )
    opened = assert_same(tmp_path / "a.exr")
    assert {block.dtype for _, block in opened.blocks()} == {np.dtype(kind)}
    assert max(len(block) for _, block in opened.blocks()) <= (256 if compression == "DWAB" else 32)


@pytest.mark.parametrize(
    ("data", "display"),
    [
        ((2, 1, 21, 80), (0, 0, 30, 99)),
        ((-5, -40, 14, 39), (0, 0, 9, 9)),
        ((-5, -40, 14, 39), (-9, -50, 30, 60)),
        ((0, 0, 19, 79), (40, 100, 50, 140)),
    ],
)
def test_openexr_windows(tmp_path: Path, data: tuple, display: tuple) -> None:
    """The data window inside the display window, around it, overlapping it and beside it."""
    windows = {"dataWindow": window(*data), "displayWindow": window(*display)}
    write_channels(tmp_path / "a.exr", {"RGB": noise(80, 20)}, **windows)
    if display[0] < 40:
        assert_same(tmp_path / "a.exr")
    else:
        assert not open_image(tmp_path / "a.exr").read().any()


def test_openexr_layers_luminance_alpha_and_types(tmp_path: Path) -> None:
    path, image = tmp_path / "a.exr", noise(40, 9)
    write_channels(path, {"RGBA": noise(40, 9, 4).astype(np.float16)})
    assert_same(path)
    write_channels(path, {"Y": image[..., 0], "A": image[..., 1]})
    assert_same(path)
    write_channels(path, {"b.RGB": image, "depth.Z": image[..., 0]})
    assert_same(path)
    write_channels(path, {"R": image[..., 0].astype(np.float16), "G": image[..., 1], "B": image[..., 2]})
    assert_same(path)
    write_channels(path, {name: (1e6 * image[..., 0]).astype(np.uint32) for name in "RGB"})
    assert_same(path)
    write_channels(path, {"depth.Z": image[..., 0]})
    with pytest.raises(ImageError, match=r"found depth\.Z"):
        open_image(path)


def test_openexr_tiles_and_parts(tmp_path: Path) -> None:
    path, image = tmp_path / "a.exr", noise(70, 50)
    tiles = OpenEXR.TileDescription()
    tiles.xSize, tiles.ySize, tiles.mode = 16, 24, OpenEXR.ONE_LEVEL
    write_channels(path, {"RGB": image}, type=OpenEXR.tiledimage, tiles=tiles)
    assert [len(block) for _, block in assert_same(path).blocks()] == [24, 24, 22]
    colour, other = (
        OpenEXR.Part({"name": "c"}, {"RGB": image}),
        OpenEXR.Part({"name": "z"}, {"Z": image[..., 0].copy()}),
    )
    for parts in ([colour, other], [other, colour]):
        OpenEXR.File(parts).write(str(path))
        assert_same(path)


@pytest.mark.parametrize("resolution", ["-Y 90 +X 40", "-Y 90 -X 40", "+Y 90 +X 40", "+Y 90 -X 40"])
def test_radiance_with_rows_and_columns_in_every_order(tmp_path: Path, resolution: str) -> None:
    write_image(tmp_path / "a.hdr", noise(90, 40))
    assert_same(tmp_path / "a.hdr")
    content = (tmp_path / "a.hdr").read_bytes().replace(b"-Y 90 +X 40", resolution.encode())
    (tmp_path / "b.hdr").write_bytes(content)
    assert_same(tmp_path / "b.hdr")
    upright, turned = read_image(tmp_path / "a.hdr"), read_image(tmp_path / "b.hdr")
    np.testing.assert_array_equal(
        turned, upright[:: 1 if resolution[0] == "-" else -1, :: 1 if "+X" in resolution else -1]
    )


def test_run_length_coded_radiance(tmp_path: Path) -> None:
    """Run-length coded rows have varying lengths."""
    import cv2

    image = noise(100, 300)
    image[::3] = image[0, 0]
    cv2.imwrite(str(tmp_path / "a.hdr"), image[..., ::-1])
    assert_same(tmp_path / "a.hdr")


@pytest.mark.filterwarnings("ignore:.*pixels are transparent")
def test_png_and_jpeg(tmp_path: Path) -> None:
    pixels = (255 * DRAW.random((50, 20, 4))).astype(np.uint8)
    Image.fromarray(pixels, "RGBA").save(tmp_path / "a.png")
    Image.fromarray(pixels[..., 0], "L").save(tmp_path / "b.png")
    Image.fromarray(pixels[..., :3], "RGB").save(tmp_path / "c.jpg")
    for name in ("a.png", "b.png", "c.jpg"):
        assert_same(tmp_path / name)


@pytest.mark.parametrize("read", [open_image, read_layers])
def test_a_png_is_decoded_once(read: Callable[[Path], object], tmp_path: Path) -> None:
    first, second = (Image.fromarray(np.full((4, 4, 3), code, np.uint8)) for code in (0, 255))
    first.save(tmp_path / "a.png", save_all=True, append_images=[second])
    with pytest.warns(InputWarning, match="is an animation") as caught:
        read(tmp_path / "a.png")
    assert len(caught) == 1


@pytest.mark.parametrize("suffix", [".exr", ".hdr", ".png"])
def test_truncated_images_are_refused_in_one_sentence(
    tmp_path: Path, suffix: str, capfd: pytest.CaptureFixture[str]
) -> None:
    write_image(tmp_path / f"a{suffix}", noise(100, 60))
    content = (tmp_path / f"a{suffix}").read_bytes()
    path = tmp_path / f"cut{suffix}"
    for tenth in range(10):
        path.write_bytes(content[: len(content) * tenth // 10])
        with pytest.raises(ImageError) as caught:
            open_image(path).read()
        assert str(caught.value).startswith(f"{path}: ")
        assert "\n" not in str(caught.value)
    if suffix == ".exr":
        assert "truncated or damaged in row 64 of 100" in str(caught.value)
    assert capfd.readouterr() == ("", "")
    with pytest.raises(StorageError, match="no such file"):
        open_image(tmp_path / f"none{suffix}")


@pytest.mark.parametrize("suffix", [".exr", ".hdr"])
def test_memory_is_that_of_one_block(tmp_path: Path, suffix: str) -> None:
    write_image(tmp_path / f"a{suffix}", np.ones((2000, 512, 3), np.float32))  # 12 MB
    opened = open_image(tmp_path / f"a{suffix}")
    tracemalloc.start()
    total = sum(float(block.sum(dtype=np.float64)) for _, block in opened.blocks())
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert total == 2000 * 512 * 3
    assert peak < 2 << 20


def test_an_array_is_read_in_blocks() -> None:
    image = noise(70, 5)
    opened = rows_of(image, rows=30)
    assert [len(block) for _, block in opened.blocks()] == [30, 30, 10]
    np.testing.assert_array_equal(opened.read(), image)
