"""Chunks of PNG files: texts are no colours, and long or damaged texts are no reason to refuse pixels."""

import struct
import warnings
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import ImageCms

from formats.errors import ImageError, InputWarning
from formats.image import read_image
from tests.formats.image.png_files import CODES, SRGB, chunk, numbers, write

LONG = np.random.default_rng(0).integers(32, 127, 2**21).astype(np.uint8).tobytes()
"""More than Pillow reads of a text, even compressed."""


def text(keyword: str, content: str) -> bytes:
    return chunk(b"tEXt", keyword.encode() + b"\0" + content.encode())


@pytest.mark.parametrize("keyword", ["gamma", "srgb", "chromaticity", "icc_profile", "transparency", "exposure"])
@pytest.mark.parametrize("content", ["1", "2.2", "1/60 s", "abcdefgh", ""])
def test_texts_are_no_colours(tmp_path: Path, keyword: str, content: str) -> None:
    path = write(tmp_path / "a.png", text(keyword, content))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.allclose(read_image(path), SRGB)


def test_a_text_does_not_hide_a_chunk(tmp_path: Path) -> None:
    path = write(tmp_path / "a.png", chunk(b"gAMA", numbers(1.0)), text("gamma", "0.45455"), text("srgb", "0"))
    with pytest.warns(InputWarning, match="gAMA chunk says that the values are linear"):
        assert np.allclose(read_image(path), CODES / 255.0)


def test_texts_of_a_palette_are_no_transparency(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 2, 1, 8, 3, 0, 0, 0))
    palette, pixels = chunk(b"PLTE", bytes([0, 0, 0, 255, 255, 255])), chunk(b"IDAT", zlib.compress(bytes([0, 0, 1])))
    parts = [header, palette, text("transparency", "abc"), pixels, chunk(b"IEND", b"")]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))
    assert read_image(path)[..., :3].tolist() == [[[0.0] * 3, [1.0] * 3]]


@pytest.mark.parametrize(
    "long",
    [
        chunk(b"zTXt", b"Raw profile type xmp\0\0" + zlib.compress(LONG)),
        chunk(b"iTXt", b"XML:com.adobe.xmp\0\1\0\0\0" + zlib.compress(LONG)),
        chunk(b"tEXt", b"Comment\0" + LONG),
        chunk(b"tEXt", b"Comment\0words")[:-1] + b"?",
        chunk(b"eXIf", b"words")[:-1] + b"?",
    ],
)
def test_long_and_damaged_texts_are_passed_over(tmp_path: Path, long: bytes) -> None:
    assert np.allclose(read_image(write(tmp_path / "a.png", long)), SRGB)


@pytest.mark.parametrize("filler", [0, 2**18])
@pytest.mark.parametrize("deflated", [False, True])
def test_long_metadata_turns_a_picture_upright(tmp_path: Path, deflated: bool, filler: int) -> None:
    orientation = b'<rdf:Description xmlns:tiff="http://ns.adobe.com/tiff/1.0/" tiff:Orientation="3"/>' + b" " * filler
    packed = zlib.compress(orientation) if deflated else orientation
    content = b"XML:com.adobe.xmp\0" + bytes([deflated]) + b"\0\0\0" + packed
    path = write(tmp_path / "a.png", chunk(b"iTXt", content))
    assert np.allclose(read_image(path), SRGB[::-1, ::-1])


def test_a_large_profile_is_read(tmp_path: Path) -> None:
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("LAB")).tobytes() + LONG
    path = write(tmp_path / "a.png", chunk(b"iCCP", b"name\0\0" + zlib.compress(profile)))
    with pytest.warns(InputWarning, match="its colour profile .* is not sRGB"):
        assert np.allclose(read_image(path), SRGB)


@pytest.mark.parametrize("content", [b"", b"name", b"name\0\0words"])
def test_a_damaged_profile_is_reported(tmp_path: Path, content: bytes) -> None:
    with pytest.warns(InputWarning, match=r"its colour profile \(damaged\) is not sRGB"):
        assert np.allclose(read_image(write(tmp_path / "a.png", chunk(b"iCCP", content))), SRGB)


@pytest.mark.parametrize("kind", [b"gAMA", b"cHRM", b"sRGB", b"iCCP", b"cICP", b"tRNS"])
def test_damaged_colours_are_refused(tmp_path: Path, kind: bytes) -> None:
    path = write(tmp_path / "a.png", chunk(kind, b"word")[:-1] + b"?")
    with pytest.raises(ImageError, match=f"damaged in the chunk {kind.decode()!r} at byte 33: its checksum is wrong"):
        read_image(path)


def test_an_exposure_of_prtbake_is_reported(tmp_path: Path) -> None:
    with pytest.warns(InputWarning, match="was written with an exposure of -1.5 EV"):
        assert np.allclose(read_image(write(tmp_path / "a.png", text("exposure", "-1.5 EV"))), SRGB)


def test_a_cicp_chunk_that_says_nothing_is_passed_over(tmp_path: Path) -> None:
    path = write(tmp_path / "a.png", chunk(b"cICP", bytes([2, 2, 0, 1])), chunk(b"gAMA", numbers(1.0)))
    with pytest.warns(InputWarning, match="gAMA chunk"):
        assert np.allclose(read_image(path), CODES / 255.0)
