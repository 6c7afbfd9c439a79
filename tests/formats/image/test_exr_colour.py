"""Which channels of an OpenEXR file are its colour, where they lie, and what their numbers mean."""

import struct
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from formats.errors import ImageError, InputWarning
from formats.image import read_data, read_image, read_layers
from formats.image.rows import open_image
from tests.formats.image.handmade import spread, thinned, write_levels, write_subsampled

IMAGE = np.random.default_rng(3).gamma(0.5, 4, (16, 32, 3)).astype(np.float32)
OTHER = np.full((16, 32, 3), 0.5, np.float32)
AP1 = (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767)
AP1_TO_REC709 = [[1.70505, -0.62179, -0.08326], [-0.13026, 1.14080, -0.01055], [-0.02400, -0.12897, 1.15297]]
"""ACEScg to linear sRGB with Bradford adaptation, as renderers and games publish it."""


def planes(prefix: str, image: np.ndarray = OTHER, letters: tuple[str, ...] | str = "RGB") -> dict[str, np.ndarray]:
    return {f"{prefix}{letter}": np.ascontiguousarray(image[..., i]) for i, letter in enumerate(letters)}


def write(path: Path, channels: dict[str, np.ndarray], **header: object) -> Path:
    kinds = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File({**kinds, **header}, channels).write(str(path))
    return path


def write_parts(path: Path, parts: dict[str, dict[str, np.ndarray]], deep: str = "") -> Path:
    kinds = {
        name: {"type": OpenEXR.deepscanline, "compression": OpenEXR.ZIPS_COMPRESSION}
        if name == deep
        else {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
        for name in parts
    }
    OpenEXR.File([OpenEXR.Part({"name": name, **kinds[name]}, parts[name]) for name in parts]).write(str(path))
    return path


def samples() -> np.ndarray:
    """Two samples in each pixel."""
    deep = np.empty((16, 32), object)
    for pixel in np.ndindex(deep.shape):
        deep[pixel] = np.full(2, 0.25, np.float32)
    return deep


def assert_both(path: Path, expected: np.ndarray) -> None:
    """Complete images and blocks of rows have the same pixels."""
    np.testing.assert_array_equal(read_image(path), expected)
    np.testing.assert_array_equal(open_image(path).read(), expected)


@pytest.mark.parametrize(
    ("channels", "layer", "other"),
    [
        (planes("ViewLayer.AO.") | planes("ViewLayer.Combined.", IMAGE), "layer ViewLayer.Combined", "ViewLayer.AO"),
        (planes("albedo.") | planes("Beauty.", IMAGE), "layer Beauty", "albedo"),
        (planes("diffuse.", letters=("red", "green", "blue")) | planes("rgba.", IMAGE), "layer rgba", "diffuse"),
    ],
)
def test_a_layer_named_as_the_picture_is_taken_with_a_warning(
    tmp_path: Path, channels: dict[str, np.ndarray], layer: str, other: str
) -> None:
    path = write(tmp_path / "a.exr", channels)
    with pytest.warns(InputWarning, match=f"those of {layer}; the file also has layer {other}$"):
        assert_both(path, IMAGE)
    with pytest.warns(InputWarning):
        opened = open_image(path)
    assert (opened.layer, opened.other_layers) == (layer, (f"layer {other}",))


def test_the_default_channels_are_taken_without_a_word(tmp_path: Path) -> None:
    path = write(tmp_path / "a.exr", planes("", IMAGE) | planes("A.Combined.") | planes("N.", letters="XYZ"))
    assert_both(path, IMAGE)
    assert open_image(path).other_layers == ("layer A.Combined",)


def test_the_only_layer_of_colour_is_taken_without_a_word(tmp_path: Path) -> None:
    channels = planes("sky.", IMAGE, ("red", "green", "blue")) | planes("N.", letters="XYZ") | planes("normal.")
    assert_both(write(tmp_path / "a.exr", channels | {"crypto00.r": OTHER[..., 0].copy()}), IMAGE)


@pytest.mark.parametrize("prefixes", [("diffuse.", "specular."), ("A.Combined.", "B.Combined.")])
def test_layers_that_are_equally_good_are_listed(tmp_path: Path, prefixes: tuple[str, str]) -> None:
    path = write(tmp_path / "a.exr", planes(prefixes[0]) | planes(prefixes[1]))
    listed = ", ".join(f"layer {prefix[:-1]}" for prefix in prefixes)
    for reader in (read_image, open_image, read_layers):
        with pytest.raises(ImageError, match=f"several layers of colour: {listed}; expected"):
            reader(path)


@pytest.mark.parametrize(
    ("parts", "taken"),
    [
        ({"albedo": planes(""), "beauty": planes("", IMAGE)}, "part beauty"),
        ({"C": planes("", IMAGE), "albedo": planes("albedo.")}, "part C"),
        ({"mine": planes("", IMAGE), "albedo": planes("albedo.")}, "part mine"),
        ({"ViewLayer.AO": planes(""), "ViewLayer.Combined": planes("", IMAGE)}, "part ViewLayer.Combined"),
    ],
)
def test_a_part_is_chosen_like_a_layer(tmp_path: Path, parts: dict[str, dict[str, np.ndarray]], taken: str) -> None:
    with pytest.warns(InputWarning, match=f"those of {taken}; the file also has"):
        assert_both(write_parts(tmp_path / "a.exr", parts), IMAGE)


def test_parts_without_choice(tmp_path: Path) -> None:
    only = {"z": {"Z": OTHER[..., 0].copy()}, "normal": planes(""), "x": planes("", IMAGE)}
    assert_both(write_parts(tmp_path / "only.exr", only), IMAGE)
    with pytest.raises(ImageError, match=r"part rgba\.left, part rgba\.right"):
        read_image(write_parts(tmp_path / "b.exr", {"rgba.left": planes(""), "rgba.right": planes("")}))


@pytest.mark.parametrize(
    "channels",
    [
        planes("", letters="XYZ"),
        planes("position.", letters="XYZ"),
        planes("motion.", letters="XY"),
        planes("UV.", letters="UV"),
        planes("depth.", letters="Z"),
        planes("", letters="Z"),
        planes("coverage.", letters="Y"),
        planes("Normals."),
        planes("ViewLayer.CryptoObject00.", letters="rgb"),
        planes("uCryptoAsset00."),
        planes("N_world."),
        planes("MotionVec."),
        planes("VRayObjectID."),
        planes("displacement."),
    ],
)
def test_data_are_no_picture(tmp_path: Path, channels: dict[str, np.ndarray]) -> None:
    path = write(tmp_path / "a.exr", channels)
    # A coverage may be a mask.
    for reader in (read_image, open_image) if "coverage.Y" in channels else (read_image, open_image, read_data):
        with pytest.raises(ImageError, match=f"has no colour: .*found {', '.join(sorted(channels))}; positions"):
            reader(path)


def test_names_are_shown_in_one_short_line(tmp_path: Path) -> None:
    content = write(tmp_path / "a.exr", {"N.aaa": OTHER[..., 0].copy(), "y" * 200: OTHER[..., 0].copy()}).read_bytes()
    (tmp_path / "a.exr").write_bytes(content.replace(b"N.aaa", b"N\n\x1b\ta"))
    with pytest.raises(ImageError, match=f"found N\\?\\?\\?a, {'y' * 59}…; positions"):
        read_image(tmp_path / "a.exr")


def test_luminance_beside_depth_is_grey(tmp_path: Path) -> None:
    path = write(tmp_path / "a.exr", {"Y": IMAGE[..., 0].copy(), "Z": OTHER[..., 0].copy()}, chromaticities=AP1)
    assert_both(path, np.repeat(IMAGE[..., :1], 3, axis=2))


@pytest.mark.parametrize(
    ("prefix", "letters", "alpha"),
    [
        ("", "RGB", "A"),
        ("ViewLayer.Combined.", "RGB", "A"),
        ("", "rgb", "a"),
        ("rgba.", ("red", "green", "blue"), "alpha"),
    ],
)
def test_the_alpha_of_the_colour_is_known(tmp_path: Path, prefix: str, letters: tuple[str, ...], alpha: str) -> None:
    channels = planes(prefix, IMAGE, letters) | {prefix + alpha: OTHER[..., 0].copy(), "x.A": IMAGE[..., 0].copy()}
    layers = read_layers(write(tmp_path / "a.exr", channels)).layers
    assert layers.keys() == {"A", "x.A"}
    np.testing.assert_array_equal(layers["A"], OTHER[..., 0])


def test_a_damaged_part_is_not_replaced_by_another(tmp_path: Path) -> None:
    """The binding leaves out parts that it cannot read, so that `albedo` has the number of `beauty`."""
    parts = {"z": {"Z": IMAGE[..., 0].copy()}, "beauty": planes("", IMAGE), "albedo": planes("")}
    path = write_parts(tmp_path / "a.exr", parts)
    content = path.read_bytes()
    # Each part has one chunk. The table of their offsets precedes the first: its part, row, size and content.
    chunk = next(start for start in range(24, len(content)) if content[start - 24 :][:8] == struct.pack("<Q", start))
    path.write_bytes(content[: chunk + 8] + struct.pack("<i", 1 << 30) + content[chunk + 12 :])
    for reader in (read_image, open_image, read_layers):
        with pytest.warns(InputWarning, match="those of part beauty"), pytest.raises(ImageError, match="or damaged"):
            reader(path)


def test_luminance_without_a_layer_comes_before_layers_of_colour(tmp_path: Path) -> None:
    grey = np.repeat(IMAGE[..., :1], 3, axis=2)
    assert_both(write(tmp_path / "a.exr", {"Y": IMAGE[..., 0].copy()} | planes("AO.")), grey)
    # Of layers with the same rank those in colour come first.
    with pytest.warns(InputWarning, match="those of layer sky; the file also has layer mask"):
        assert_both(write(tmp_path / "b.exr", {"mask.Y": OTHER[..., 0].copy()} | planes("sky.", IMAGE)), IMAGE)


def test_deep_pictures_are_refused_by_name(tmp_path: Path) -> None:
    deep = dict.fromkeys("RGBA", samples())
    header = {"compression": OpenEXR.ZIPS_COMPRESSION, "type": OpenEXR.deepscanline}
    OpenEXR.File(header, deep).write(str(tmp_path / "a.exr"))
    for reader in (read_image, open_image, read_layers):
        with pytest.raises(ImageError, match=r"is a deep picture.*oiiotool --flatten"):
            reader(tmp_path / "a.exr")
    for parts in ({"d": deep, "flat": planes("", IMAGE)}, {"flat": planes("", IMAGE), "d": deep}):
        assert_both(write_parts(tmp_path / "b.exr", parts, deep="d"), IMAGE)


@pytest.mark.parametrize("zipped", [False, True])
@pytest.mark.parametrize("sampling", [((2, 2), (2, 2), (2, 2)), ((1, 1), (2, 1), (1, 2)), ((4, 1), (1, 8), (2, 2))])
def test_subsampled_channels_are_spread_over_their_pixels(
    tmp_path: Path, sampling: tuple[tuple[int, int], ...], zipped: bool
) -> None:
    path, by_name = tmp_path / "a.exr", dict(zip("RGB", sampling, strict=True))
    stored, expected = thinned(IMAGE, by_name), spread(IMAGE, by_name)
    write_subsampled(path, stored, by_name, (0, 0, 31, 15), zipped=zipped)
    assert_both(path, expected)
    write_subsampled(path, stored, by_name, (8, 16, 39, 31), (0, 0, 49, 39), zipped)
    framed = np.zeros((40, 50, 3), np.float32)
    framed[16:32, 8:40] = expected
    assert_both(path, framed)
    write_subsampled(path, stored, by_name, (-8, -16, 23, -1), (0, -12, 19, -5), zipped)
    assert_both(path, expected[4:12, 8:28])


def test_subsampled_layers_are_spread_too(tmp_path: Path) -> None:
    sampling = {**dict.fromkeys("RGB", (1, 1)), "A": (2, 2)}
    image = np.concatenate([IMAGE, OTHER[..., :1] * np.arange(32)[None, :, None].astype(np.float32)], axis=2)
    write_subsampled(tmp_path / "a.exr", thinned(image, sampling), sampling, (0, 0, 31, 15))
    np.testing.assert_array_equal(read_layers(tmp_path / "a.exr").layers["A"], spread(image, sampling)[..., 3])


def test_luminance_and_chroma_are_refused_by_name(tmp_path: Path) -> None:
    sampling = {"Y": (1, 1), "RY": (2, 2), "BY": (2, 2)}
    write_subsampled(tmp_path / "a.exr", thinned(IMAGE, sampling), sampling, (0, 0, 31, 15))
    for reader in (read_image, open_image):
        with pytest.raises(ImageError, match=r"luminance and chroma \(BY, RY, Y\)"):
            reader(tmp_path / "a.exr")


@pytest.mark.parametrize("ripmap", [False, True])
def test_the_largest_level_of_mipmaps_is_read(tmp_path: Path, ripmap: bool) -> None:
    write_levels(tmp_path / "a.exr", IMAGE, ripmap)
    assert_both(tmp_path / "a.exr", IMAGE)


def test_chromaticities_are_converted_to_rec709(tmp_path: Path) -> None:
    path = write(tmp_path / "a.exr", planes("", IMAGE), chromaticities=AP1)
    expected = IMAGE @ np.array(AP1_TO_REC709).T
    with pytest.warns(InputWarning, match="chromaticities means ACES AP1; the colours are converted to Rec.709"):
        found = read_image(path)
    np.testing.assert_allclose(found, expected, atol=2e-5 * IMAGE.max())
    with pytest.warns(InputWarning):
        assert_both(path, found)
    with pytest.warns(InputWarning):
        np.testing.assert_array_equal(read_layers(path).image, found)
    # Data is no colour.
    np.testing.assert_array_equal(read_data(path)[..., 0], IMAGE[..., 0])


def test_clipped_colours_are_counted(tmp_path: Path) -> None:
    image = np.ones((2, 4, 3), np.float32)
    image[0, 0] = 0.0, 1.0, 0.0
    image[1, 1, 2] = -1.0  # a fault, not a colour outside Rec.709
    path = write(tmp_path / "a.exr", planes("", image), chromaticities=AP1)
    counted = "1 of 8 pixels are outside Rec.709; their negative values, 0.03"
    with pytest.warns(InputWarning, match="converted"), pytest.warns(InputWarning, match=counted):
        clipped = open_image(path, clip=True).read()
    assert clipped[0, 0].tolist() == pytest.approx([0.0, 1.14080, 0.0], abs=1e-4)
    assert clipped[1, 1].min() < 0.0
    np.testing.assert_allclose(clipped[0, 1:], 1.0, rtol=1e-5)


@pytest.mark.parametrize(
    ("header", "sentence"),
    [
        ({"colorInteropID": "lin_ap1_scene"}, "means ACES AP1"),
        ({"colorInteropID": "srgb_rec709_scene"}, "srgb_rec709_scene is not understood; the colours are taken as"),
        ({"chromaticities": (0.0,) * 8}, "chromaticities is not understood"),
        ({"acesImageContainerFlag": 1}, "means ACES AP0"),
        ({"oiio:ColorSpace": "ACEScg"}, "oiio:ColorSpace = ACEScg means ACES AP1"),
        ({"oiio:ColorSpace": "lin_rec2020_scene"}, "means Rec.2020"),
        ({"oiio:ColorSpace": "sRGB"}, "oiio:ColorSpace = sRGB is not understood; the colours are taken as linear"),
        ({"chromaticities": (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.314, 0.351)}, r"red \(0.68, 0.32\), green"),
    ],
)
def test_other_statements_about_primaries(tmp_path: Path, header: dict[str, object], sentence: str) -> None:
    with pytest.warns(InputWarning, match=sentence):
        read_image(write(tmp_path / "a.exr", planes("", IMAGE), **header))


@pytest.mark.parametrize(
    "header",
    [
        {"chromaticities": (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.31271, 0.32902)},
        {"colorInteropID": "lin_rec709_scene"},
        {"colorInteropID": "data"},
        {"oiio:ColorSpace": "Linear"},
        {"oiio:ColorSpace": "scene_linear"},
        {"oiio:ColorSpace": "lin_rec709_scene"},
    ],
)
def test_rec709_is_left_as_it_is(tmp_path: Path, header: dict[str, object]) -> None:
    assert_both(write(tmp_path / "a.exr", planes("", IMAGE), **header), IMAGE)


def test_an_attribute_of_another_type_is_reported(tmp_path: Path) -> None:
    content = write(tmp_path / "a.exr", planes("", IMAGE), chromaticities=AP1).read_bytes()
    (tmp_path / "a.exr").write_bytes(content.replace(b"chromaticities\0chroma", b"chromaticities\0chrome"))
    with pytest.warns(InputWarning, match="chromaticities is not understood"):
        assert_both(tmp_path / "a.exr", IMAGE)


@pytest.mark.parametrize(
    "display", [(0, 0, 299_999, 1), (0, 0, 9_999, 9_999), (0, 0, 99_999, 99_999), (0, -(1 << 29), 31, 1 << 29)]
)
def test_absurd_display_windows_are_refused(tmp_path: Path, display: tuple[int, ...]) -> None:
    content = write(tmp_path / "a.exr", planes("", IMAGE)).read_bytes()
    start = content.index(b"displayWindow\0box2i\0") + len(b"displayWindow\0box2i\0") + 4
    (tmp_path / "a.exr").write_bytes(content[:start] + struct.pack("<4i", *display) + content[start + 16 :])
    for reader in (read_image, open_image, read_layers):
        with pytest.raises(ImageError, match=r"\d+x\d+"):
            reader(tmp_path / "a.exr")


def test_a_cube_map_in_a_later_part_is_known_as_one(tmp_path: Path) -> None:
    parts = [
        OpenEXR.Part({"name": "z", "type": OpenEXR.scanlineimage}, {"Z": OTHER[..., 0].copy()}),
        OpenEXR.Part({"name": "c", "type": OpenEXR.scanlineimage, "envmap": OpenEXR.ENVMAP_CUBE}, planes("", IMAGE)),
    ]
    OpenEXR.File(parts).write(str(tmp_path / "a.exr"))
    assert open_image(tmp_path / "a.exr").cube
