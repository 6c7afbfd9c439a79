"""Images: Radiance files against known bytes and a second decoder, OpenEXR layouts, the sRGB curve."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from PIL import Image

from formats.errors import ImageError, InputWarning
from formats.image import read_data, read_image, read_layers, write_image
from formats.image.png import to_linear, to_srgb

HEADER = b"#?RADIANCE\n# by hand\nFORMAT=32-bit_rle_rgbe\n\n"
PICTURES = npst.arrays(
    np.float32,
    st.tuples(st.integers(1, 6), st.integers(1, 40), st.just(3)),
    elements=st.floats(0, 2.0**100, width=32),
)


def noise(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(5).gamma(0.5, 4, (height, width, 3)).astype(np.float32)


def test_radiance_bytes_have_known_values(tmp_path):
    # (r, g, b)·2^(e−136); an exponent of 0 is black whatever the mantissas.
    pixels = bytes([128, 64, 32, 129, 255, 0, 1, 136, 200, 100, 50, 0, 128, 128, 128, 1])
    (tmp_path / "a.hdr").write_bytes(HEADER + b"-Y 2 +X 2\n" + pixels)
    expected = [[[1, 0.5, 0.25], [255, 0, 1]], [[0, 0, 0], [2.0**-128] * 3]]
    np.testing.assert_array_equal(read_image(tmp_path / "a.hdr"), np.array(expected, np.float32))


def test_run_length_rows_have_known_values(tmp_path):
    runs = (
        bytes([2, 2, 0, 8]) + bytes([136, 128]) + bytes([8, 1, 2, 3, 4, 5, 6, 7, 8]) + bytes([132, 0, 132, 9, 136, 136])
    )
    (tmp_path / "new.hdr").write_bytes(HEADER + b"-Y 1 +X 8\n" + runs)
    expected = np.stack([np.full(8, 128), np.arange(1, 9), np.repeat([0, 9], 4)], axis=1)[None]
    np.testing.assert_array_equal(read_image(tmp_path / "new.hdr"), expected.astype(np.float32))
    # The old run: (1, 1, 1, n) repeats the previous pixel; a second marker counts 256 times as much.
    old = bytes([128, 0, 0, 136, 1, 1, 1, 3, 1, 1, 1, 1, 7, 128, 0, 136])
    (tmp_path / "old.hdr").write_bytes(HEADER + b"-Y 1 +X 261\n" + old)
    row = np.zeros((1, 261, 3), np.float32)
    row[0, :260, 0] = 128
    row[0, 260] = [7, 128, 0]
    np.testing.assert_array_equal(read_image(tmp_path / "old.hdr"), row)


def test_rows_and_columns_may_be_reversed(tmp_path):
    pixels = bytes([128, 0, 0, 136, 0, 128, 0, 136, 0, 0, 128, 136, 128, 128, 0, 136])
    (tmp_path / "a.hdr").write_bytes(HEADER + b"-Y 2 +X 2\n" + pixels)
    upright = read_image(tmp_path / "a.hdr")
    (tmp_path / "b.hdr").write_bytes(HEADER + b"+Y 2 -X 2\n" + pixels)
    np.testing.assert_array_equal(read_image(tmp_path / "b.hdr"), upright[::-1, ::-1])


@settings(max_examples=60, deadline=None, derandomize=True, database=None)
@given(image=PICTURES)
def test_radiance_agrees_with_a_second_codec(tmp_path_factory, image):
    import cv2

    folder = tmp_path_factory.mktemp("hdr")
    write_image(folder / "ours.hdr", image)
    ours = read_image(folder / "ours.hdr")
    np.testing.assert_array_equal(cv2.imread(str(folder / "ours.hdr"), cv2.IMREAD_UNCHANGED)[..., ::-1], ours)
    largest = image.max(axis=2, keepdims=True)
    # Half a step of a mantissa of at least 128; pixels below 2^-128 are black.
    assert np.all(np.abs(ours.astype(np.float64) - image) <= largest.astype(np.float64) / 256 + 2.0**-127)
    cv2.imwrite(str(folder / "theirs.hdr"), np.ascontiguousarray(image[..., ::-1]))
    theirs = cv2.imread(str(folder / "theirs.hdr"), cv2.IMREAD_UNCHANGED)[..., ::-1]
    np.testing.assert_array_equal(read_image(folder / "theirs.hdr"), theirs)


def test_a_large_run_length_coded_picture_agrees_with_a_second_codec(tmp_path):
    import cv2

    image = noise(32, 700)
    image[:, 100:400] = 0.5
    cv2.imwrite(str(tmp_path / "a.hdr"), np.ascontiguousarray(image[..., ::-1]))
    theirs = cv2.imread(str(tmp_path / "a.hdr"), cv2.IMREAD_UNCHANGED)[..., ::-1]
    np.testing.assert_array_equal(read_image(tmp_path / "a.hdr"), theirs)
    write_image(tmp_path / "b.hdr", theirs)
    np.testing.assert_array_equal(read_image(tmp_path / "b.hdr"), theirs)


@settings(max_examples=30, deadline=None, derandomize=True, database=None)
@given(
    image=npst.arrays(
        np.float32, st.tuples(st.integers(1, 9), st.integers(1, 9), st.just(3)), elements=st.floats(width=32)
    )
)
def test_openexr_stores_float32_exactly(tmp_path_factory, image):
    path = tmp_path_factory.mktemp("exr") / "a.exr"
    write_image(path, image)
    np.testing.assert_array_equal(read_image(path), image)


def test_openexr_accepts_strided_views(tmp_path):
    image = noise(10, 12)
    write_image(tmp_path / "a.exr", image[::-1, ::2])
    np.testing.assert_array_equal(read_image(tmp_path / "a.exr"), image[::-1, ::2])


def write_channels(path, channels, **header):
    import OpenEXR

    kinds = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    contiguous = {name: np.ascontiguousarray(pixels) for name, pixels in channels.items()}
    OpenEXR.File({**kinds, **header}, contiguous).write(str(path))


def test_openexr_layers_grey_and_alpha(tmp_path):
    image, path = noise(6, 8), tmp_path / "a.exr"
    half = np.concatenate([image, image[..., :1]], axis=2).astype(np.float16)
    write_channels(path, {"RGBA": half})
    np.testing.assert_array_equal(read_image(path), half[..., :3].astype(np.float32))
    write_channels(path, {"Y": image[..., 1]})
    np.testing.assert_array_equal(read_image(path), np.repeat(image[..., 1:2], 3, axis=2))
    write_channels(path, {"diffuse": image, "depth.Z": image[..., 0]})
    np.testing.assert_array_equal(read_image(path), image)
    write_channels(path, {"depth.Z": image[..., 0]})
    with pytest.raises(ImageError, match=r"found depth\.Z"):
        read_image(path)


def test_openexr_needs_no_standard_streams(tmp_path: Path) -> None:
    program = (
        "import os, sys\nos.close(1)\nos.close(2)\nsys.stdout = sys.stderr = None\n"
        "import numpy as np\nfrom formats.image import read_image, write_image\n"
        "write_image(sys.argv[1], np.full((2, 4, 3), 0.5))\nassert read_image(sys.argv[1]).mean() == 0.5\n"
    )
    assert subprocess.run([sys.executable, "-c", program, tmp_path / "a.exr"], check=False).returncode == 0


def test_layers_are_read_separately_and_plain_readers_ignore_them(tmp_path):
    import cv2

    image, path = noise(6, 8), tmp_path / "a.exr"
    error, coverage = image[::-1] * 0.1, image[..., 0] / 9
    write_image(path, image, layers={"error": error, "coverage": coverage}, attributes={"prtbake.spp": "64"})
    np.testing.assert_array_equal(read_image(path), image)
    read = read_layers(path)
    np.testing.assert_array_equal(read.image, image)
    assert read.layers.keys() == {"error", "coverage"}
    np.testing.assert_array_equal(read.layers["error"], error.astype(np.float32))
    np.testing.assert_array_equal(read.layers["coverage"], coverage)
    assert read.attributes == {"prtbake.spp": "64"}
    assert channel_names(path) == {"R", "G", "B", "error.R", "error.G", "error.B", "coverage.Y"}
    write_image(tmp_path / "a.hdr", image, layers={"error": error}, attributes={"prtbake.spp": "64"})
    np.testing.assert_array_equal(
        cv2.imread(str(tmp_path / "a.hdr"), cv2.IMREAD_UNCHANGED)[..., ::-1], read_layers(tmp_path / "a.hdr").image
    )
    assert read_layers(tmp_path / "a.hdr").layers == {}


def test_positions_and_normals_are_written_as_x_y_z_and_survive(tmp_path):
    import OpenEXR

    image, layers = noise(6, 8), {name: noise(6, 8) + k for k, name in enumerate(("position", "normal", "radiance"))}
    write_image(tmp_path / "a.exr", image, layers=layers)
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        channels = {name: channel.pixels for name, channel in file.channels().items()}
    colours = {f"radiance.{c}" for c in "RGB"} | set("RGB")
    assert channels.keys() == colours | {f"{name}.{c}" for name in ("position", "normal") for c in "XYZ"}
    np.testing.assert_array_equal(channels["normal.Z"], layers["normal"][..., 2].astype(np.float32))
    read = read_layers(tmp_path / "a.exr")
    assert read.layers.keys() == layers.keys()
    for name, layer in layers.items():
        np.testing.assert_array_equal(read.layers[name], layer.astype(np.float32))
    np.testing.assert_array_equal(read.image, read_image(tmp_path / "a.exr"))


def test_foreign_layers_keep_their_names(tmp_path):
    image, path = noise(4, 5), tmp_path / "a.exr"
    write_channels(path, {"diffuse": image, "depth.Z": image[..., 0], "A": image[..., 1]})
    read = read_layers(path)
    np.testing.assert_array_equal(read.image, image)
    assert read.layers.keys() == {"depth.Z", "A"}
    np.testing.assert_array_equal(read.layers["depth.Z"], image[..., 0])


def test_a_layer_of_another_size_is_refused(tmp_path):
    with pytest.raises(ImageError, match=r"layer coverage: expected shape \[6, 8, 3\] or \[6, 8\]"):
        write_image(tmp_path / "a.exr", noise(6, 8), layers={"coverage": np.zeros((6, 7))})
    assert list(tmp_path.iterdir()) == []


def channel_names(path):
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        return set(file.channels())


def test_openexr_parts_and_windows(tmp_path):
    import OpenEXR

    image, path = noise(6, 8), tmp_path / "a.exr"
    parts = [OpenEXR.Part({"name": "z"}, {"Z": image[..., 0].copy()}), OpenEXR.Part({"name": "c"}, {"RGB": image})]
    OpenEXR.File(parts).write(str(path))
    np.testing.assert_array_equal(read_image(path), image)

    def window(left, top, right, bottom):
        return np.array([left, top], np.int32), np.array([right, bottom], np.int32)

    write_channels(path, {"RGB": image}, dataWindow=window(2, 1, 9, 6), displayWindow=window(0, 0, 11, 9))
    display = read_image(path)
    assert display.shape == (10, 12, 3)
    np.testing.assert_array_equal(display[1:7, 2:10], image)
    assert display.sum(dtype=np.float64) == image.sum(dtype=np.float64)
    write_channels(path, {"RGB": image}, dataWindow=window(-1, -2, 6, 3), displayWindow=window(0, 0, 3, 2))
    np.testing.assert_array_equal(read_image(path), image[2:5, 1:5])


def test_srgb_curve_and_its_inverse():
    values = np.linspace(0, 1, 1001)
    np.testing.assert_allclose(to_linear(to_srgb(values)), values, atol=1e-7)
    np.testing.assert_allclose(to_srgb([0.0031308, 0.5, 2, -1]), [0.04044994, 0.73535698, 1, 0], atol=1e-7)


def test_png_survives_with_exposure_and_its_text(tmp_path):
    codes = np.arange(256, dtype=np.uint8).repeat(3).reshape(16, 16, 3)
    Image.fromarray(codes).save(tmp_path / "codes.png")
    linear = read_image(tmp_path / "codes.png")
    write_image(tmp_path / "again.png", linear / 4, exposure=2)
    with Image.open(tmp_path / "again.png") as picture:
        np.testing.assert_array_equal(np.asarray(picture), codes)
        assert picture.text == {"exposure": "2 EV"}
    write_image(tmp_path / "peak.png", np.full((1, 1, 3), [np.inf, -1, 0]), exposure=3)
    with pytest.warns(InputWarning, match="exposure of 3 EV"):
        assert read_image(tmp_path / "peak.png").tolist() == [[[1, 0, 0]]]


@pytest.mark.parametrize("mode", ["L", "LA", "RGBA", "P", "1"])
def test_png_of_every_mode(tmp_path, mode):
    Image.fromarray(np.full((4, 5, 3), 255, np.uint8)).convert(mode).save(tmp_path / "a.png")
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), np.ones((4, 5, 3), np.float32))


def test_grey_of_16_bits_keeps_its_range(tmp_path):
    stored = np.array([[0, 30000, 65535]], np.uint16)
    Image.fromarray(stored).save(tmp_path / "a.png")
    expected = np.repeat(to_linear(stored / 65535.0)[..., None], 3, axis=2)
    np.testing.assert_allclose(read_image(tmp_path / "a.png"), expected, rtol=1e-6)


@pytest.mark.parametrize("suffix", [".exr", ".hdr", ".png"])
def test_truncated_images_are_refused_in_one_sentence(tmp_path, suffix, capfd):
    write_image(tmp_path / f"a{suffix}", noise(40, 60))
    content = (tmp_path / f"a{suffix}").read_bytes()
    path = tmp_path / f"cut{suffix}"
    for tenth in range(10):
        path.write_bytes(content[: len(content) * tenth // 10])
        with pytest.raises(ImageError) as caught:
            read_image(path)
        assert str(caught.value).startswith(f"{path}: ")
        assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("suffix", [".exr", ".hdr", ".png", ".jpg"])
def test_other_kinds_are_refused(tmp_path, suffix):
    (tmp_path / f"a{suffix}").write_text("a poem, not a picture")
    with pytest.raises(ImageError):
        read_image(tmp_path / f"a{suffix}")
    with pytest.raises(ImageError, match=r"read; expected \.exr, .* or \.jpeg, found '\.gif'"):
        read_image(tmp_path / "a.gif")
    with pytest.raises(ImageError, match=r"written; expected \.exr, \.hdr or \.png, found '\.jpg'"):
        write_image(tmp_path / "a.jpg", np.zeros((2, 2, 3)))


def test_damaged_radiance_is_refused(tmp_path):
    path = tmp_path / "a.hdr"
    for content, sentence in (
        (HEADER.replace(b"rgbe", b"xyze") + b"-Y 1 +X 1\n1234", "32-bit_rle_rgbe"),
        (HEADER + b"+X 1 -Y 1\n1234", "rows must come first"),
        (HEADER + b"-Y 0 +X 1\n", "empty"),
        (HEADER + b"-Y 1000000 +X 1000000\n1234", "truncated"),
        (HEADER + b"-Y 1 +X 8\n" + bytes([2, 2, 0, 8, 200, 1]), "row 0 of 1"),
        (HEADER + b"-Y 1 +X 8\n" + bytes([2, 2, 0, 8, 0, 0]), "row 0 of 1"),
        (HEADER + b"-Y 1 +X 2\n" + bytes([1, 1, 1, 2]), "row 0 of 1"),
    ):
        path.write_bytes(content)
        with pytest.raises(ImageError, match=sentence):
            read_image(path)


def test_invalid_pixels_and_shapes_are_refused(tmp_path):
    nan = np.full((2, 2, 3), np.nan)
    for suffix in (".png", ".hdr"):
        with pytest.raises(ImageError, match="row 0, column 0"):
            write_image(tmp_path / f"a{suffix}", nan)
    with pytest.raises(ImageError, match=r"a\.exr: .*shape"):
        write_image(tmp_path / "a.exr", np.zeros((2, 2)))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("mode", "stored", "expected"),
    [
        ("L", [[0, 51, 255]], [0, 0.2, 1]),
        ("RGB", [[[51, 9, 9], [102, 0, 255], [255, 0, 0]]], [0.2, 0.4, 1]),
        ("RGBA", [[[51, 9, 9, 0], [102, 0, 255, 1], [255, 0, 0, 255]]], [0.2, 0.4, 1]),
        ("I;16", [[0, 13107, 65535]], [0, 0.2, 1]),
    ],
)
def test_levels_of_a_png_are_its_stored_first_channel(tmp_path, mode, stored, expected):
    array = np.array(stored, np.uint16 if mode == "I;16" else np.uint8)
    Image.fromarray(array).save(tmp_path / "a.png")
    levels = read_data(tmp_path / "a.png")[..., 0]
    assert (levels.dtype, levels.shape) == (np.float64, (1, 3))
    np.testing.assert_allclose(levels[0], expected, atol=1e-15)


def test_levels_of_linear_images_are_their_first_channel(tmp_path):
    picture = np.array([[[0.25, 9, 9], [0.5, 0, 0]]], np.float32)
    for suffix in (".exr", ".hdr"):
        write_image(tmp_path / f"a{suffix}", picture)
        np.testing.assert_allclose(read_data(tmp_path / f"a{suffix}")[..., 0], [[0.25, 0.5]], atol=0.04)


def test_a_jpeg_is_decoded_as_srgb(tmp_path):
    Image.fromarray(np.full((8, 8, 3), 188, np.uint8)).save(tmp_path / "a.jpg", quality=100)
    picture = read_image(tmp_path / "a.jpg")
    assert (picture.shape, picture.dtype) == ((8, 8, 3), np.float32)
    np.testing.assert_allclose(picture, 0.503, atol=0.006)
