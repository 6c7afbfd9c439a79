"""The header of Radiance images: line ends, factors, primaries, and lines that are ignored."""

from pathlib import Path

import numpy as np
import pytest

from formats.errors import ImageError, InputWarning
from formats.image import gamut, read_data, read_image, write_image
from formats.image.gamut import Primaries, convert, matrix_to_rec709
from formats.image.rows import open_image

IMAGE = np.random.default_rng(4).gamma(0.5, 4, (20, 40, 3)).astype(np.float32)


def rewritten(path: Path, *lines: str, end: str = "\n", resolution: str = "-Y 20 +X 40") -> np.ndarray:
    """Write IMAGE with further header lines, and return what a plain header gives."""
    write_image(path, IMAGE)
    plain = read_image(path)
    pixels = path.read_bytes().partition(b"+X 40\n")[2]
    header = end.join(["#?RADIANCE", *lines, "FORMAT=32-bit_rle_rgbe", "", resolution, ""])
    path.write_bytes(header.encode() + pixels)
    return plain


def assert_both(path: Path, expected: np.ndarray) -> None:
    np.testing.assert_array_equal(read_image(path), expected)
    np.testing.assert_array_equal(open_image(path).read(), expected)


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_lines_end_in_any_way(tmp_path: Path, end: str) -> None:
    assert_both(tmp_path / "a.hdr", rewritten(tmp_path / "a.hdr", "# Adobe", "VIEW= -vtv", end=end))


@pytest.mark.parametrize("resolution", ["-Y 20 +X 40", "+Y 20 -X 40"])
def test_values_are_divided_by_exposure_and_colour_correction(tmp_path: Path, resolution: str) -> None:
    path = tmp_path / "a.hdr"
    plain = rewritten(path, "EXPOSURE=4", "EXPOSURE= 0.5", "COLORCORR= 2 1 0.5", resolution=resolution)
    if resolution[0] == "+":
        plain = plain[::-1, ::-1]
    with pytest.warns(InputWarning, match=r"a.hdr: the values are divided by 4, 2, 1, the EXPOSURE and COLORCORR"):
        assert_both(path, plain / np.array([4, 2, 1], np.float32))
    with pytest.warns(InputWarning):
        np.testing.assert_array_equal(read_data(path)[..., 0], plain[..., 0] / 4)


@pytest.mark.parametrize("line", ["EXPOSURE = 4", "exposure=4", "Exposure =4.0"])
def test_keys_may_be_spelt_in_other_ways(tmp_path: Path, line: str) -> None:
    plain = rewritten(tmp_path / "a.hdr", line, resolution="-Y  20   +X  40")
    with pytest.warns(InputWarning, match="the values are divided by 4"):
        assert_both(tmp_path / "a.hdr", plain / np.float32(4))
    rewritten(tmp_path / "a.hdr", "Format = 32-bit_rle_xyze")
    with pytest.raises(ImageError, match="found FORMAT= 32-bit_rle_xyze; convert the image to RGB"):
        read_image(tmp_path / "a.hdr")


def test_factors_of_one_and_those_of_earlier_pictures_do_nothing(tmp_path: Path) -> None:
    lines = "EXPOSURE=1.0000", "COLORCORR=1 1 1", "\tEXPOSURE=8", "GAMMA=1", "PIXASPECT=1", "SOFTWARE=x"
    assert_both(tmp_path / "a.hdr", rewritten(tmp_path / "a.hdr", *lines))


@pytest.mark.parametrize("line", ["EXPOSURE=0", "EXPOSURE=-1", "EXPOSURE=bright", "EXPOSURE=nan", "COLORCORR=1 2"])
def test_factors_that_are_no_positive_numbers_are_ignored_with_a_warning(tmp_path: Path, line: str) -> None:
    plain = rewritten(tmp_path / "a.hdr", line)
    with pytest.warns(InputWarning, match=f"{line} is ignored: expected positive numbers"):
        assert_both(tmp_path / "a.hdr", plain)


def test_absurd_factors_are_refused(tmp_path: Path) -> None:
    rewritten(tmp_path / "a.hdr", "EXPOSURE=1e200", "EXPOSURE=1e200")
    with pytest.raises(ImageError, match="multiply to inf, inf, inf; expected 1e-30 to 1e"):
        read_image(tmp_path / "a.hdr")


def test_a_gamma_is_ignored_with_a_warning(tmp_path: Path) -> None:
    plain = rewritten(tmp_path / "a.hdr", "GAMMA=2.2")
    with pytest.warns(InputWarning, match="GAMMA=2.2 is ignored: the values are taken as linear"):
        assert_both(tmp_path / "a.hdr", plain)


def test_primaries_are_converted_to_rec709(tmp_path: Path) -> None:
    path = tmp_path / "a.hdr"
    plain = rewritten(path, "PRIMARIES= 0.708 0.292 0.170 0.797 0.131 0.046 0.3127 0.3290")
    with pytest.warns(InputWarning):
        expected = convert(plain, matrix_to_rec709("", Primaries("", gamut.REC2020)))
    with pytest.warns(InputWarning, match="PRIMARIES means Rec.2020; the colours are converted to Rec.709"):
        assert_both(path, expected)
    # Data is no colour.
    np.testing.assert_array_equal(read_data(path)[..., 0], plain[..., 0])


@pytest.mark.parametrize(
    "primaries",
    [
        "0 0 0 0 0 0 0 0",  # Photoshop
        "0.640 0.330 0.290 0.600 0.150 0.060 0.333 0.333",  # Radiance
        "0.640 0.330 0.300 0.600 0.150 0.060 0.3127 0.3290",
    ],
)
def test_primaries_that_mean_the_same_as_none(tmp_path: Path, primaries: str) -> None:
    assert_both(tmp_path / "a.hdr", rewritten(tmp_path / "a.hdr", f"PRIMARIES={primaries}"))


def test_primaries_that_are_not_eight_numbers_are_reported(tmp_path: Path) -> None:
    plain = rewritten(tmp_path / "a.hdr", "PRIMARIES=Rec.2020")
    with pytest.warns(InputWarning, match="PRIMARIES is not understood"):
        assert_both(tmp_path / "a.hdr", plain)


def test_a_header_without_end_is_refused(tmp_path: Path) -> None:
    for content in (
        b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n",
        b"#?RADIANCE" + b"x" * 5000,
        b"#?RADIANCE\r\n\r\n-Y 2 +X 2",
    ):
        (tmp_path / "a.hdr").write_bytes(content)
        with pytest.raises(ImageError, match="the Radiance header has no end"):
            read_image(tmp_path / "a.hdr")


@pytest.mark.parametrize("resolution", ["-Y 1 +X 1000000000", "-Y 1000000000 +X 1", f"-Y {10**30} +X 1"])
def test_absurd_sizes_are_refused(tmp_path: Path, resolution: str) -> None:
    """A row of old run lengths may hold billions of pixels in a few bytes."""
    content = bytes([1, 0, 0, 128]) + bytes([1, 1, 1, 255]) * 4
    (tmp_path / "a.hdr").write_bytes(f"#?RADIANCE\n\n{resolution}\n".encode() + content)
    for reader in (read_image, open_image):
        with pytest.raises(ImageError, match=r"expected at most 262144 pixels|truncated|expected a resolution"):
            reader(tmp_path / "a.hdr")


def test_negative_values_are_written_as_black_with_a_warning(tmp_path: Path) -> None:
    image = IMAGE.copy()
    image[0, 0] = -0.5, 1.0, 2.0
    with pytest.warns(InputWarning, match=r"a.hdr: 1 pixels are negative, down to -0.5; .hdr stores them as 0"):
        write_image(tmp_path / "a.hdr", image)
    assert read_image(tmp_path / "a.hdr")[0, 0].tolist() == [0.0, 1.0, 2.0]
    with pytest.raises(ImageError, match=r"a.hdr: 1 pixels are not finite.*row 0, column 0"):
        write_image(tmp_path / "a.hdr", np.where(image < 0, np.inf, image))
