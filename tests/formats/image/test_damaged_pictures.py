"""Damage that decoders pass over is found, and a refusal says what the file is."""

import struct
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from formats.errors import ImageError, InputWarning
from formats.image import read_alpha, read_data, read_image, write_image
from formats.image.rows import open_image

IMAGE = np.random.default_rng(3).random((16, 32, 3), dtype=np.float32)


def chunk_start(content: bytes, kind: bytes) -> int:
    return content.index(kind) - 4


@pytest.mark.parametrize("damage", ["zeros", "flipped", "no end", "cut"])
def test_a_png_whose_pixels_are_damaged_is_refused(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "a.png"
    write_image(path, IMAGE)
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    if damage == "zeros":
        content[middle:] = bytes(len(content) - middle)
    if damage == "flipped":
        content[middle] ^= 1
    if damage == "no end":
        del content[chunk_start(bytes(content), b"IEND") :]
    if damage == "cut":
        del content[middle:]
    path.write_bytes(content)
    expected = "IEND, is missing" if damage == "no end" else r"damaged in the chunk 'IDAT' at byte \d+"
    with pytest.raises(ImageError, match=expected):
        read_image(path)


def test_damaged_remarks_and_bytes_after_the_end_of_a_png_do_no_harm(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    write_image(path, IMAGE)
    expected, content = read_image(path), path.read_bytes()
    end = chunk_start(content, b"IEND")
    remark = struct.pack(">I", 7) + b"tIME" + bytes(7) + b"sum?"
    path.write_bytes(content[:end] + remark + content[end:] + b"trailing")
    np.testing.assert_array_equal(read_image(path), expected)


def coded(row: np.ndarray, width: int) -> bytes:
    """A row [W,4] of bytes in literals of 16, under a marker of `width`."""
    planes = (row[first : first + 16, channel].tobytes() for channel in range(4) for first in range(0, len(row), 16))
    return bytes([2, 2, width >> 8, width & 255]) + b"".join(bytes([len(plane)]) + plane for plane in planes)


def write_coded(path: Path, rows: list[bytes], width: int) -> None:
    header = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {len(rows)} +X {width}\n"
    path.write_bytes(header.encode() + b"".join(rows))


def test_coded_rows_of_another_width_are_refused(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(128, 140, (8, 32, 4), np.uint8)
    path = tmp_path / "a.hdr"
    write_coded(path, [coded(row, 32) for row in pixels], 32)
    assert read_image(path).shape == (8, 32, 3)
    write_coded(path, [coded(row, 32) for row in pixels], 16)
    with pytest.raises(ImageError, match="truncated or damaged in row 0 of 8"):
        read_image(path)


def test_rows_of_zeros_after_coded_rows_are_refused(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(128, 140, (8, 32, 4), np.uint8)
    rows = [coded(row, 32) for row in pixels]
    path = tmp_path / "a.hdr"
    write_coded(path, [*rows[:5], bytes(128), bytes(128), bytes(128)], 32)
    with pytest.raises(ImageError, match="truncated or damaged in row 5 of 8"):
        read_image(path)
    write_coded(path, [*rows[:5], pixels[5].tobytes(), *rows[6:]], 32)
    plain = read_image(path)
    write_coded(path, rows, 32)
    np.testing.assert_array_equal(plain, read_image(path))
    write_coded(path, 8 * [bytes(128)], 32)
    assert not read_image(path).any()


KINDS = {
    "RIFF....WEBP": "is a picture of the kind WebP, which is not read; convert it to",
    "II*\0": "is a picture of the kind TIFF, which is not read; convert it to",
    "....ftypavif": "is a picture of the kind AVIF, which is not read",
    "<!DOCTYPE html>": "is not {}, but a web page",
    "version https://git-lfs.github.com/spec/v1": "but a pointer of Git LFS; run `git lfs pull`",
    "": "is not {}: expected b'.*' at its start, found b''",
}


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".exr", ".hdr"])
@pytest.mark.parametrize("start", KINDS)
def test_other_files_are_named(tmp_path: Path, suffix: str, start: str) -> None:
    path = tmp_path / f"a{suffix}"
    path.write_bytes(start.encode())
    name = {".png": "PNG", ".jpg": "JPEG", ".exr": "OpenEXR", ".hdr": "Radiance"}[suffix]
    with pytest.raises(ImageError, match=KINDS[start].format(name)):
        read_image(path)


@pytest.mark.parametrize("suffix", [".png", ".exr", ".hdr"])
@pytest.mark.parametrize("other", [".png", ".jpg", ".exr", ".hdr"])
def test_a_picture_of_another_suffix_is_to_be_renamed(tmp_path: Path, suffix: str, other: str) -> None:
    path = tmp_path / f"a{suffix}"
    write_image(path, IMAGE)
    if other == suffix:
        return
    with pytest.raises(ImageError, match=f"rename it to {suffix}"):
        read_image(path.rename(tmp_path / f"b{other}"))


def write_exr(path: Path, channels: dict[str, np.ndarray], **header: object) -> Path:
    OpenEXR.File({"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION, **header}, channels).write(
        str(path)
    )
    return path


def test_an_exr_with_a_preview_is_read(tmp_path: Path) -> None:
    path = write_exr(tmp_path / "a.exr", {"RGB": IMAGE}, preview=OpenEXR.PreviewImage(4, 2))
    np.testing.assert_array_equal(read_image(path), IMAGE)
    np.testing.assert_array_equal(open_image(path).read(), IMAGE)


def test_exr_texts_that_are_not_utf_8_are_named(tmp_path: Path) -> None:
    path = write_exr(tmp_path / "a.exr", {"RGB": IMAGE}, comments="Xberbelichtet")
    path.write_bytes(path.read_bytes().replace(b"Xberbelichtet", b"\xdcberbelichtet"))
    with pytest.raises(ImageError, match=r"not UTF-8: b'\\xdcberbelichtet'; .* oiiotool --eraseattrib"):
        read_image(path)


def test_exr_attributes_of_an_unknown_type_are_named(tmp_path: Path) -> None:
    path = write_exr(tmp_path / "a.exr", {"RGB": IMAGE}, a_name_with_22_letters="\1")
    content = path.read_bytes().replace(b"a_name_with_22_letters\0string\0", 2 * b"deepImageState\0")
    assert len(content) == path.stat().st_size
    path.write_bytes(content)
    with pytest.raises(ImageError, match="has an unsupported attribute type: deepImageState; save"):
        read_image(path)


@pytest.mark.parametrize("name", ["A", "mask.A", "R", "Mask", "alpha"])
def test_the_only_channel_of_an_exr_is_data(tmp_path: Path, name: str) -> None:
    path = write_exr(tmp_path / "a.exr", {name: np.ascontiguousarray(IMAGE[..., 0])})
    np.testing.assert_array_equal(read_data(path), np.repeat(IMAGE[..., :1], 3, axis=2))
    alpha = read_alpha(path)
    assert (alpha is not None) == name.endswith("A")
    with pytest.raises(ImageError, match="has no colour"):
        read_image(path)


def test_several_channels_without_colour_are_no_data(tmp_path: Path) -> None:
    plane = np.ascontiguousarray(IMAGE[..., 0])
    path = write_exr(tmp_path / "a.exr", {"A": plane, "Z": plane})
    with pytest.raises(ImageError, match="has no colour"):
        read_data(path)


def test_colours_under_transparent_pixels_are_reported(tmp_path: Path) -> None:
    alpha = np.ones(IMAGE.shape[:2])
    alpha[:8] = 0.5
    path = tmp_path / "a.png"
    write_image(path, IMAGE * alpha[..., None], alpha=alpha)
    with pytest.warns(InputWarning, match="50% of the pixels are transparent; their colours are read as if opaque"):
        open_image(path)


def test_an_exposure_that_the_file_states_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    write_image(path, IMAGE, exposure=-2.0)
    with pytest.warns(InputWarning, match="was written with an exposure of -2 EV; its values are read as displayed"):
        dark = read_image(path)
    assert dark.mean() == pytest.approx(IMAGE.mean() / 4.0, rel=0.02)
