"""PNG and JPEG as colours and as data: curves, profiles, orientation, 16 bits, and sizes that cannot be true."""

import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageCms

from formats.errors import ImageError, InputWarning
from formats.image import gamut, read_data, read_image, read_layers
from formats.image.gamut import Primaries, convert, matrix_to_rec709
from formats.image.png import to_linear
from tests.formats.image.png_files import CODES, SRGB, chunk, numbers, write

DEEP = np.random.default_rng(7).integers(0, 65536, (7, 9, 4), dtype=np.uint16)
SRGB_PROFILE = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()


def write_deep(path: Path, channels: int, interlaced: bool = False) -> Path:
    """Write the first channels of DEEP, unfiltered; an interlaced picture of one row is stored as it is."""
    stored = DEEP[:, :, :channels]
    colour = {1: 0, 2: 4, 3: 2, 4: 6}[channels]
    header = struct.pack(">IIBBBBB", 9, 7, 16, colour, 0, 0, int(interlaced))
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in (adam7(stored) if interlaced else stored))
    content = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + content)
    return path


def adam7(image: np.ndarray) -> list[np.ndarray]:
    """The rows of the seven passes of an interlaced image."""
    passes = ((0, 0, 8, 8), (0, 4, 8, 8), (4, 0, 8, 4), (0, 2, 4, 4), (2, 0, 4, 2), (0, 1, 2, 2), (1, 0, 2, 1))
    return [row for top, left, down, across in passes for row in image[top::down, left::across] if row.size]


@pytest.mark.parametrize("gamma", [1.0, 0.55556, 0.3])
def test_a_gamma_chunk_is_the_curve(tmp_path: Path, gamma: float) -> None:
    path = write(tmp_path / "a.png", chunk(b"gAMA", numbers(gamma)))
    with pytest.warns(InputWarning, match="gAMA chunk says that the values are"):
        found = read_image(path)
    np.testing.assert_allclose(found, (CODES / 255.0) ** (1.0 / gamma), rtol=1e-6)
    np.testing.assert_array_equal(read_data(path)[..., 0], CODES[..., 0] / 255.0)


def test_linear_and_encoded_pictures_of_one_sky_are_equal(tmp_path: Path) -> None:
    linear = np.random.default_rng(8).random((8, 16, 3))
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    pictures = []
    for name, values, chunks in (("a", srgb, ()), ("b", linear, (chunk(b"gAMA", numbers(1.0)),))):
        rows = b"".join(b"\0" + row.tobytes() for row in np.rint(65535 * values).astype(">u2"))
        header = chunk(b"IHDR", struct.pack(">IIBBBBB", 16, 8, 16, 2, 0, 0, 0))
        body = header + b"".join(chunks) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
        (tmp_path / f"{name}.png").write_bytes(b"\x89PNG\r\n\x1a\n" + body)
        if chunks:
            with pytest.warns(InputWarning, match="are linear"):
                pictures.append(read_image(tmp_path / f"{name}.png"))
        else:
            pictures.append(read_image(tmp_path / f"{name}.png"))
    np.testing.assert_allclose(pictures[0], pictures[1], atol=4e-5)


@pytest.mark.parametrize(
    "chunks",
    [
        (chunk(b"gAMA", numbers(0.45455)),),
        (chunk(b"sRGB", b"\0"), chunk(b"gAMA", numbers(1.0))),
        (chunk(b"gAMA", numbers(0.45455)), chunk(b"cHRM", numbers(0.3127, 0.329, 0.64, 0.33, 0.3, 0.6, 0.15, 0.06))),
        (chunk(b"iCCP", b"x\0\0" + zlib.compress(SRGB_PROFILE)), chunk(b"gAMA", numbers(1.0))),
        (chunk(b"cICP", bytes([1, 13, 0, 1])), chunk(b"gAMA", numbers(1.0))),
    ],
)
def test_files_that_say_srgb_are_read_without_a_word(tmp_path: Path, chunks: tuple[bytes, ...]) -> None:
    np.testing.assert_array_equal(read_image(write(tmp_path / "a.png", *chunks)), SRGB)


def test_a_gamma_of_zero_is_ignored_with_a_warning(tmp_path: Path) -> None:
    with pytest.warns(InputWarning, match="gAMA chunk of 0 is ignored"):
        np.testing.assert_array_equal(read_image(write(tmp_path / "a.png", chunk(b"gAMA", numbers(0.0)))), SRGB)


def test_primaries_of_a_png_are_converted(tmp_path: Path) -> None:
    stored = (*gamut.P3_D65[6:], *gamut.P3_D65[:6])
    path = write(tmp_path / "a.png", chunk(b"cHRM", numbers(*stored)))
    with pytest.warns(InputWarning, match="cHRM chunk means P3 D65; the colours are converted"):
        found = read_image(path)
    with pytest.warns(InputWarning):
        matrix = matrix_to_rec709("", Primaries("", gamut.P3_D65))
    np.testing.assert_array_equal(found, convert(SRGB, matrix))
    np.testing.assert_array_equal(read_data(path)[..., 0], CODES[..., 0] / 255.0)


def test_a_cicp_chunk_comes_first(tmp_path: Path) -> None:
    path = write(tmp_path / "a.png", chunk(b"cICP", bytes([1, 8, 0, 1])), chunk(b"sRGB", b"\0"))
    with pytest.warns(InputWarning, match="cICP chunk says that the values are linear"):
        np.testing.assert_allclose(read_image(path), CODES / 255.0, rtol=1e-6)
    for colours in ([9, 16, 0, 1], [9, 18, 0, 1], [1, 13, 0, 0], [1, 13, 1, 1], [2, 13, 0, 1]):
        write(path, chunk(b"cICP", bytes(colours)))
        with pytest.raises(ImageError, match=f"primaries {colours[0]}, transfer {colours[1]} .*save it as sRGB"):
            read_image(path)
        np.testing.assert_array_equal(read_data(path)[..., 0], CODES[..., 0] / 255.0)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_another_colour_profile_is_reported(tmp_path: Path, suffix: str) -> None:
    path, picture = tmp_path / f"a{suffix}", Image.fromarray(CODES)
    picture.save(path, icc_profile=SRGB_PROFILE)
    srgb = read_image(path)
    picture.save(path, icc_profile=swapped_profile())
    with pytest.warns(InputWarning, match=r"its colour profile \(sRGB built-in\) is not sRGB and is ignored"):
        np.testing.assert_array_equal(read_image(path), srgb)
    picture.save(path, icc_profile=b"damaged")
    with pytest.warns(InputWarning, match=r"its colour profile \(damaged\)"):
        np.testing.assert_array_equal(read_image(path), srgb)
    np.testing.assert_array_equal(read_data(path)[..., 0], np.asarray(Image.open(path))[..., 0] / 255.0)


def swapped_profile() -> bytes:
    """An sRGB profile whose red and blue primaries are exchanged; its name says nothing of it."""
    return SRGB_PROFILE.replace(b"rXYZ", b"tmp!").replace(b"bXYZ", b"rXYZ").replace(b"tmp!", b"bXYZ")


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
@pytest.mark.parametrize("interlaced", [False, True])
def test_all_of_16_bits_are_read(tmp_path: Path, channels: int, interlaced: bool) -> None:
    path = write_deep(tmp_path / "a.png", channels, interlaced)
    np.testing.assert_allclose(read_data(path)[..., 0], DEEP[..., 0] / 65535.0, rtol=1e-15)
    shown = DEEP[..., :3] if channels > 2 else DEEP[..., :1].repeat(3, axis=2)
    np.testing.assert_allclose(read_image(path), to_linear(shown / 65535.0), rtol=1e-6)
    alpha = read_layers(path).layers.get("A")
    assert (alpha is None) == (channels in (1, 3))
    if alpha is not None:
        np.testing.assert_allclose(alpha, DEEP[..., channels - 1] / 65535.0, rtol=1e-6)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_a_second_decoder_agrees_on_filtered_rows(tmp_path: Path, dtype: type) -> None:
    import cv2

    smooth = (np.linspace(0, 60_000, 40 * 50 * 3).reshape(40, 50, 3) * np.iinfo(dtype).max / 65535).astype(dtype)
    cv2.imwrite(str(tmp_path / "a.png"), smooth)
    theirs = cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED)[..., ::-1]
    np.testing.assert_allclose(read_image(tmp_path / "a.png"), to_linear(theirs / np.iinfo(dtype).max), rtol=1e-6)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_pictures_are_turned_upright(tmp_path: Path, orientation: int, suffix: str) -> None:
    from PIL import ImageOps

    path, exif = tmp_path / f"a{suffix}", Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(CODES.repeat(8, axis=0).repeat(8, axis=1)).save(path, exif=exif)
    with Image.open(path) as picture:
        upright = np.asarray(ImageOps.exif_transpose(picture))
    np.testing.assert_array_equal(read_image(path), to_linear(upright / 255.0).astype(np.float32))
    np.testing.assert_array_equal(read_data(path)[..., 0], upright[..., 0] / 255.0)


def test_16_bits_are_turned_upright_too(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    path = write_deep(tmp_path / "a.png", 3)
    content = path.read_bytes()
    path.write_bytes(content[:33] + chunk(b"eXIf", exif.tobytes().removeprefix(b"Exif\0\0")) + content[33:])
    np.testing.assert_allclose(read_data(path)[..., 0], np.rot90(DEEP[..., 0], -1) / 65535.0, rtol=1e-15)


def test_roughness_is_the_same_from_png_and_jpeg(tmp_path: Path) -> None:
    for suffix in (".png", ".jpg", ".jpeg"):
        Image.fromarray(np.full((16, 16), 128, np.uint8)).save(tmp_path / f"a{suffix}")
        np.testing.assert_allclose(read_data(tmp_path / f"a{suffix}")[..., 0], 128 / 255)


def test_cmyk_is_a_warning_as_colour_and_refused_as_data(tmp_path: Path) -> None:
    Image.fromarray(CODES).convert("CMYK").save(tmp_path / "a.jpg")
    with pytest.warns(InputWarning, match="stores CMYK; it is converted to RGB without a colour profile"):
        assert read_image(tmp_path / "a.jpg").shape == (7, 9, 3)
    with pytest.raises(ImageError, match="stores CMYK, of which no channel is data"):
        read_data(tmp_path / "a.jpg")[..., 0]


def exif_of_a_camera(orientation: int) -> bytes:
    """EXIF with an orientation and, at the offset 56, the Interoperability index R03."""
    image = struct.pack("<HHHIIHHIII", 2, 0x0112, 3, 1, orientation, 0x8769, 4, 1, 38, 0)
    exif = struct.pack("<HHHIII", 1, 0xA005, 4, 1, 56, 0)
    index = struct.pack("<HHHI4sI", 1, 1, 2, 4, b"R03", 0)
    return b"Exif\0\0II*\0\x08\0\0\0" + image + exif + index


def test_an_unreadable_index_does_not_hide_the_orientation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pillow 11.0 raises KeyError if there is none."""
    Image.fromarray(CODES).save(tmp_path / "a.png", exif=exif_of_a_camera(3))
    monkeypatch.setattr(Image.Exif, "get_ifd", lambda exif, tag: {}[tag])
    np.testing.assert_array_equal(read_data(tmp_path / "a.png")[::-1, ::-1], CODES / 255.0)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_adobe_rgb_of_cameras_is_converted(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    Image.fromarray(CODES).save(path, exif=exif_of_a_camera(1))
    linear = (np.asarray(Image.open(path)) / 255.0) ** (563 / 256)
    matrix = [[1.39836, -0.39836, 0.0], [0.0, 1.0, 0.0], [0.0, -0.04293, 1.04293]]
    with pytest.warns(InputWarning, match=r"its EXIF \(R03\) means Adobe RGB; the colours are converted to Rec.709"):
        np.testing.assert_allclose(read_image(path), linear @ np.transpose(matrix), atol=1e-4)
    np.testing.assert_array_equal(read_data(path)[..., 0], np.asarray(Image.open(path))[..., 0] / 255.0)


@pytest.mark.parametrize("segment", [b"http://ns.adobe.com/hdr-gain-map/1.0/", b"urn:iso:std:iso:ts:21496:-1\0"])
def test_a_gain_map_is_reported(tmp_path: Path, segment: bytes) -> None:
    path = tmp_path / "a.jpg"
    Image.fromarray(CODES).save(path)
    expected, content = read_image(path), path.read_bytes()
    path.write_bytes(content[:2] + b"\xff\xe2" + struct.pack(">H", len(segment) + 2) + segment + content[2:])
    with pytest.warns(InputWarning, match="its gain map for HDR displays is ignored, so that highlights end at white"):
        np.testing.assert_array_equal(read_image(path), expected)
    read_data(path)[..., 0]


@pytest.mark.parametrize("bits", [1, 2, 4, 8, 16])
@pytest.mark.parametrize("channels", [1, 3])
def test_one_transparent_colour(tmp_path: Path, bits: int, channels: int) -> None:
    if channels == 3 and bits < 8:
        return
    path, white = tmp_path / "a.png", 2**bits - 1
    stored = DEEP[:, :8, :channels] >> (16 - bits)
    if bits < 8:
        rows = np.packbits((stored >> np.arange(bits)[::-1]) & 1, axis=None).reshape(7, -1)
    else:
        rows = stored.astype(">u2" if bits == 16 else ">u1").reshape(7, -1).view(np.uint8)
    header = struct.pack(">IIBBBBB", 8, 7, bits, channels - 1, 0, 0, 0)
    clear = chunk(b"tRNS", stored[3, 4].astype(">u2").tobytes())
    pixels = chunk(b"IDAT", zlib.compress(b"".join(b"\0" + row.tobytes() for row in rows)))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + clear + pixels + chunk(b"IEND", b""))
    layers = read_layers(path)
    np.testing.assert_array_equal(layers.layers["A"], (stored != stored[3, 4]).any(axis=2))
    np.testing.assert_allclose(layers.image, np.broadcast_to(to_linear(stored / white), (7, 8, 3)), rtol=1e-6)
    np.testing.assert_array_equal(read_data(path)[..., 0], stored[..., 0] / white)


def test_a_palette_with_alpha(tmp_path: Path) -> None:
    palette = Image.fromarray(CODES).quantize(4)
    palette.save(tmp_path / "a.png", transparency=bytes([0, 64, 128, 255]))
    expected = np.asarray(palette.convert("RGB"))
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), to_linear(expected / 255.0).astype(np.float32))
    alpha = np.array([0, 64, 128, 255])[np.asarray(palette)] / 255.0
    np.testing.assert_allclose(read_layers(tmp_path / "a.png").layers["A"], alpha, rtol=1e-6)


@pytest.mark.parametrize(
    ("width", "height", "sentence"),
    [(40_000, 40_000, "is truncated: .* cannot hold 40000x40000"), (1 << 30, 1, "at most 262144"), (0, 5, "empty")],
)
@pytest.mark.parametrize("reader", [read_image, read_data, read_layers])
def test_absurd_sizes_are_refused(
    tmp_path: Path, width: int, height: int, sentence: str, reader: Callable[[Path], object]
) -> None:
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    content = header + chunk(b"IDAT", zlib.compress(bytes(1000))) + chunk(b"IEND", b"")
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + content)
    with pytest.raises(ImageError, match=sentence):
        reader(tmp_path / "a.png")


@pytest.mark.parametrize(("side", "sentence"), [(60_000, "too many pixels; reduce it"), (9_000, "is truncated: ")])
def test_a_jpeg_of_absurd_size_is_refused(tmp_path: Path, side: int, sentence: str) -> None:
    Image.fromarray(CODES).save(tmp_path / "a.jpg")
    content = (tmp_path / "a.jpg").read_bytes()
    start = content.index(b"\xff\xc0") + 5
    (tmp_path / "a.jpg").write_bytes(content[:start] + struct.pack(">2H", side, side) + content[start + 4 :])
    with pytest.raises(ImageError, match=sentence):
        read_image(tmp_path / "a.jpg")


def test_a_large_picture_is_read_without_a_word(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pillow warns of pictures with more than MAX_IMAGE_PIXELS."""
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 40)
    assert read_image(write(tmp_path / "a.png")).shape == (7, 9, 3)
