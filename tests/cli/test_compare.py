"""`prtbake compare`: its output, its files and its errors."""

import json
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from formats.image import read_image, write_image
from tests.cli.command_line import Outcome, Run

SHAPE = (24, 32, 3)


def picture(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.2, 0.8, SHAPE).astype(np.float32)


def save(folder: Path, name: str, image: np.ndarray, error: np.ndarray | None = None, **texts: str) -> Path:
    path = folder / name
    attributes = {f"prtbake.{text}": value for text, value in texts.items()}
    write_image(path, image, layers=None if error is None else {"error": error}, attributes=attributes)
    return path


@pytest.fixture
def pair(tmp_path: Path) -> tuple[Path, Path]:
    reference = picture()
    return save(tmp_path, "a.exr", 1.1 * reference), save(tmp_path, "b.exr", reference)


@pytest.fixture
def noisy(tmp_path: Path) -> tuple[Path, Path]:
    """Two pictures that differ by noise alone."""
    paths = []
    for seed, name, sigma in ((1, "n.exr", 0.1), (2, "m.exr", 0.02)):
        drawn = sigma * np.random.default_rng(seed).normal(size=SHAPE)
        texts = {"passes": "8", "seed": str(seed), "scene": "ball"}
        paths.append(save(tmp_path, name, picture() + drawn, np.full(SHAPE, sigma), **texts))
    return paths[0], paths[1]


def sentence(outcome: Outcome, folder: Path) -> str:
    """Return the error message of a failed command, without the folder."""
    assert outcome.code == 1
    assert "Traceback" not in outcome.err
    assert outcome.err.startswith("prtbake: ")
    return outcome.err.replace("\n", "").replace(f"{folder}/", "")


def test_every_figure_is_printed_and_in_json(prtbake: Run, pair: tuple[Path, Path]) -> None:
    figures = json.loads(prtbake("compare", *pair, "--json").out)
    names = ["mse", "relative_mse", "relative_rmse", "ssim", "ssim_quarter", "flip", "hdr_flip"]
    assert list(figures) == [*names, "hdr_exposures", "pixels", "exposure"]
    assert figures["relative_rmse"] == pytest.approx(0.1, rel=1e-5)
    assert figures["pixels"] == 24 * 32
    assert figures["ssim_quarter"] is None
    lines = prtbake("compare", *pair).out.splitlines()
    values = {line.split()[0]: line.split()[1] for line in lines}
    assert list(values) == [*names, "hdr_exposures"]
    assert values["ssim_quarter"] == "unknown:"
    assert float(values["flip"]) == pytest.approx(figures["flip"], rel=1e-4)


def test_noise_is_removed_unless_kept(prtbake: Run, noisy: tuple[Path, Path]) -> None:
    figures = json.loads(prtbake("compare", *noisy, "--json").out)
    free = figures["noise_free"]
    assert figures["mse"] == pytest.approx(0.1**2 + 0.02**2, rel=0.1)
    assert free["mse"]["low"] < 0.0 < free["mse"]["high"] < 0.1 * figures["mse"]
    assert free["relative_rmse"]["low"] == 0.0
    assert free["flip"]["low"] == 0.0
    assert free["flip"]["value"] < 0.6 * figures["flip"]
    assert free["of_noise"]["flip"] == pytest.approx(figures["flip"], rel=0.25)
    lines = prtbake("compare", *noisy).out.splitlines()
    assert lines[0].startswith("mse ")
    assert " without noise " in lines[0]
    assert "noise_free" not in json.loads(prtbake("compare", *noisy, "--keep-noise", "--json").out)


def test_correlated_noise_is_not_removed(prtbake: Run, noisy: tuple[Path, Path]) -> None:
    outcome = prtbake("compare", noisy[0], noisy[0], "--json")
    assert outcome.code == 0
    assert "are the same picture" in outcome.err.replace("\n", " ")
    assert "noise_free" not in json.loads(outcome.out)


def test_errors_of_a_bake_are_not_removed_from_flip(prtbake: Run, tmp_path: Path, pair: tuple[Path, Path]) -> None:
    baked = save(tmp_path, "s.exr", 1.1 * picture(), np.full(SHAPE, 0.01))
    outcome = prtbake("compare", baked, pair[1], "--json")
    assert "correlated between neighbouring pixels" in outcome.err.replace("\n", " ")
    figures = json.loads(outcome.out)
    assert set(figures["noise_free"]) == {"mse", "relative_mse", "relative_rmse", "of_noise"}
    assert figures["noise_free"]["mse"]["value"] == pytest.approx(figures["mse"] - 1e-4, rel=1e-4)


@pytest.mark.parametrize("bad", [np.inf, -1.0, np.nan])
def test_an_invalid_error_layer_is_reported(prtbake: Run, tmp_path: Path, bad: float) -> None:
    error = np.full(SHAPE, 0.1)
    error[3, 4] = bad
    path = save(tmp_path, "n.exr", picture(1), error, passes="1")
    outcome = prtbake("compare", path, save(tmp_path, "b.exr", picture()), "--json")
    assert outcome.code == 0
    assert "n.exr: 3 of 2304 values of its error layer are negative or not finite" in outcome.err.replace("\n", " ")
    assert "noise_free" not in json.loads(outcome.out)


@pytest.mark.parametrize(
    ("channels", "sentence"),
    [("R", "error.R without error.G and error.B"), ("RG", "error.R and error.G without error.B")],
)
def test_an_error_layer_without_some_channels_is_reported(
    prtbake: Run, tmp_path: Path, channels: str, sentence: str
) -> None:
    layers = {f"error.{channel}": np.full(SHAPE[:2], 0.1, np.float32) for channel in channels}
    pixels = {"RGB": np.ascontiguousarray(picture(1), np.float32), **layers}
    OpenEXR.File({"prtbake.passes": "8"}, pixels).write(str(tmp_path / "n.exr"))
    outcome = prtbake("compare", tmp_path / "n.exr", save(tmp_path, "b.exr", picture()), "--json")
    assert outcome.code == 0
    assert f"n.exr: its error layer has {sentence}; the metrics" in outcome.err.replace("\n", " ")
    assert "noise_free" not in json.loads(outcome.out)


def test_pictures_that_differ_by_less_than_their_noise_are_reported(prtbake: Run, tmp_path: Path) -> None:
    error = np.full(SHAPE, 0.3)
    paths = [save(tmp_path, n, picture() + d, error, passes="8") for n, d in (("a.exr", 0.0), ("b.exr", 0.001))]
    assert "differ by less than their noise" in prtbake("compare", *paths).err.replace("\n", " ")


@pytest.mark.parametrize("option", ["--picture", "--sheet"])
def test_a_sheet_and_maps_are_written(prtbake: Run, tmp_path: Path, noisy: tuple[Path, Path], option: str) -> None:
    mask = save(tmp_path, "mask.png", np.ones(SHAPE) * (np.arange(32) < 16)[:, None])
    sheet, maps = tmp_path / "sheet.png", [tmp_path / name for name in ("d.exr", "f.exr", "h.exr", "d.png", "f.png")]
    options = ["--difference-map", maps[0], "--flip-map", maps[1], "--hdr-flip-map", maps[2], "--exposure", 1]
    assert prtbake("compare", *noisy, "--mask", mask, option, sheet, *options).code == 0
    ours, theirs = (read_image(path) for path in noisy)
    np.testing.assert_allclose(read_image(maps[0]), 2.0 * (ours - theirs), atol=1e-6)
    flip, hdr = read_image(maps[1]), read_image(maps[2])
    figures = json.loads(prtbake("compare", *noisy, "--exposure", 1, "--keep-noise", "--json").out)
    assert flip.mean() == pytest.approx(figures["flip"], rel=1e-5)
    assert hdr.mean() == pytest.approx(figures["hdr_flip"], rel=1e-5)
    height, width = read_image(sheet).shape[:2]
    assert width > 4 * height / 2 > 400
    assert prtbake("compare", *noisy, "--difference-map", maps[3], "--flip-map", maps[4], "--keep-noise").code == 0
    # Brighter is red, darker is blue; more FLIP is brighter.
    shown, off = read_image(maps[3]), (ours - theirs).mean(axis=2)
    assert (shown[off > 0.02, 0] > shown[off > 0.02, 2]).all()
    assert (shown[off < -0.02, 0] < shown[off < -0.02, 2]).all()
    assert read_image(maps[4]).shape == SHAPE


def test_given_exposures_of_hdr_flip(prtbake: Run, pair: tuple[Path, Path]) -> None:
    figures = json.loads(prtbake("compare", *pair, "--hdr-exposures", "-2,1.5", "--json").out)
    assert figures["hdr_exposures"] == {"start": -2.0, "stop": 1.5, "steps": 4}
    for text in ("3,1", "nan,1", "-200,1"):
        outcome = prtbake("compare", *pair, "--hdr-exposures", text)
        assert outcome.code == 1
        assert "within ±128 stops" in outcome.err.replace("\n", " ")
    assert prtbake("compare", *pair, "--hdr-exposures", "3").code == 2


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--fail-above", "relative_rmse=0.2", "--fail-below", "ssim=0.5"], None),
        (["--fail-above", "relative_rmse=0.05"], "a.exr: relative_rmse is 0.1, above 0.05 (--fail-above)"),
        (["--fail-below", "ssim=0.9999"], ", below 0.9999 (--fail-below)"),
        (
            ["--fail-above", "mse=0", "--fail-above", "flip=0"],
            "(--fail-above); flip is ",
        ),
        (["--fail-below", "ssim_quarter=0.1"], "ssim_quarter is unknown, which breaks --fail-below ssim_quarter=0.1"),
        (["--fail-above", "noise_free.flip=0.1"], "noise_free.flip is unknown"),
    ],
)
def test_broken_bounds_fail(
    prtbake: Run, tmp_path: Path, pair: tuple[Path, Path], options: list[str], message: str | None
) -> None:
    outcome = prtbake("compare", *pair, *options)
    assert outcome.out.startswith("mse ")
    if message is None:
        assert outcome.code == 0
    else:
        assert message in sentence(outcome, tmp_path)


def test_noise_alone_breaks_no_noise_free_bound(prtbake: Run, noisy: tuple[Path, Path]) -> None:
    assert prtbake("compare", *noisy, "--fail-above", "relative_rmse=0.05").code == 1
    assert prtbake("compare", *noisy, "--fail-above", "noise_free.relative_rmse=0.05").code == 0


def test_noise_free_bounds_are_compared_with_the_nearer_end_of_the_interval(
    prtbake: Run, tmp_path: Path, noisy: tuple[Path, Path]
) -> None:
    other = save(tmp_path, "other.exr", 1.0 - picture(), np.full(SHAPE, 0.02), passes="8", seed="5", scene="ball")
    free = json.loads(prtbake("compare", other, noisy[1], "--json").out)["noise_free"]
    low, high = free["flip"]["low"], free["ssim"]["high"]
    assert 0.0 < low < free["flip"]["value"]
    message = sentence(prtbake("compare", other, noisy[1], "--fail-above", "noise_free.flip=0.001"), tmp_path)
    assert f"other.exr: noise_free.flip is at least {low:.4g}, above 0.001 (--fail-above)" in message
    message = sentence(prtbake("compare", other, noisy[1], "--fail-below", "noise_free.ssim=0.9999"), tmp_path)
    assert f"other.exr: noise_free.ssim is at most {high:.4g}, below 0.9999 (--fail-below)" in message


def test_negative_squared_differences_are_no_more_than_noise(prtbake: Run, tmp_path: Path) -> None:
    """The estimate is unbiased: half of all pairs that differ by noise alone have a negative one."""
    sigma, below = 0.1, []
    for seed in range(8):
        drawn = sigma * np.random.default_rng([5, seed]).normal(size=SHAPE)
        path = save(tmp_path, f"{seed}.exr", picture() + drawn, np.full(SHAPE, sigma), passes="8", seed=str(seed))
        pair = path, save(tmp_path, "b.exr", picture())
        value = json.loads(prtbake("compare", *pair, "--json").out)["noise_free"]["mse"]["value"]
        (line,) = (line for line in prtbake("compare", *pair).out.splitlines() if line.startswith("mse "))
        assert f"without noise {value:.4g} (" in line
        assert line.endswith(", no more than noise") == (value < 0.0)
        below.append(value < 0.0)
    assert 0 < sum(below) < 8


@pytest.mark.parametrize("text", ["flip", "flip=", "flip=much", "psnr=3", "flip=nan", "pixels=3"])
def test_invalid_bounds_are_wrong_usage(prtbake: Run, pair: tuple[Path, Path], text: str) -> None:
    outcome = prtbake("compare", *pair, "--fail-above", text)
    assert outcome.code == 2
    assert "is not NAME=VALUE" in outcome.err


def test_sizes_that_differ_are_named(prtbake: Run, tmp_path: Path, pair: tuple[Path, Path]) -> None:
    small = save(tmp_path, "small.png", np.ones((4, 5, 3)))
    message = sentence(prtbake("compare", pair[0], small), tmp_path)
    assert "a.exr: is 32x24, but small.png is 5x4; images are compared pixel by pixel" in message
    message = sentence(prtbake("compare", *pair, "--mask", small), tmp_path)
    assert "a.exr: is 32x24, but small.png is 5x4" in message
    black = save(tmp_path, "black.png", np.zeros(SHAPE))
    assert "black.png chooses no pixel" in sentence(prtbake("compare", *pair, "--mask", black), tmp_path)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_pixels_that_are_not_finite_are_named(
    prtbake: Run, tmp_path: Path, pair: tuple[Path, Path], bad: float
) -> None:
    image = picture()
    image[5, 7, 1] = bad
    broken = save(tmp_path, "broken.exr", image)
    for order in ((broken, pair[1]), (pair[0], broken)):
        message = sentence(prtbake("compare", *order), tmp_path)
        assert "1 of 768 pixels of broken.exr are not finite, the first at row 5, column 7" in message


def test_black_pictures_are_compared(prtbake: Run, tmp_path: Path, pair: tuple[Path, Path]) -> None:
    black = save(tmp_path, "black.exr", np.zeros(SHAPE))
    other = save(tmp_path, "other.exr", np.zeros(SHAPE))
    figures = json.loads(prtbake("compare", black, other, "--json", "--sheet", tmp_path / "sheet.png").out)
    assert (figures["mse"], figures["flip"], figures["hdr_flip"], figures["ssim"]) == (0, 0, 0, 1)
    assert figures["relative_rmse"] is None
    figures = json.loads(prtbake("compare", pair[0], black, "--json").out)
    assert figures["relative_rmse"] is None
    assert figures["flip"] > 0.3
    assert figures["hdr_flip"] > 0.1


def test_a_picture_of_one_pixel_is_compared(prtbake: Run, tmp_path: Path) -> None:
    paths = [
        save(tmp_path, name, np.full((1, 1, 3), value), np.full((1, 1, 3), 0.1), passes="4", seed=name)
        for name, value in (("a.exr", 0.5), ("b.exr", 0.7))
    ]
    outcome = prtbake("compare", *paths, "--json", "--sheet", tmp_path / "sheet.png")
    assert outcome.code == 0
    figures = json.loads(outcome.out)
    assert figures["mse"] == pytest.approx(0.04, rel=1e-5)
    assert figures["ssim"] is None
    assert figures["noise_free"]["mse"]["value"] == pytest.approx(0.02, rel=1e-4)
    assert figures["noise_free"]["mse"]["low"] is None
    printed = prtbake("compare", *paths).out
    assert "interval unknown" in printed
    assert "ssim          unknown: it needs pictures of at least 11x11 pixels" in printed
    assert "ssim_quarter  unknown: it needs pictures of at least 44x44 pixels" in printed
    assert "nan" not in printed


def test_a_black_reference_has_no_relative_error(prtbake: Run, tmp_path: Path) -> None:
    paths = save(tmp_path, "a.exr", picture()), save(tmp_path, "b.exr", np.zeros_like(picture()))
    assert "relative_rmse unknown: the reference is black" in prtbake("compare", *paths).out


def test_negative_radiance_is_reported_and_shown_as_black(prtbake: Run, tmp_path: Path) -> None:
    image = picture()
    image[2, 3] = -5.0
    paths = save(tmp_path, "a.exr", image), save(tmp_path, "b.exr", np.maximum(image, 0.0))
    outcome = prtbake("compare", *paths, "--json")
    assert "a.exr: 1 of 768 pixels hold negative radiance" in outcome.err.replace("\n", "").replace(f"{tmp_path}/", "")
    figures = json.loads(outcome.out)
    assert figures["mse"] == pytest.approx(25.0 / 768, rel=1e-6)
    assert figures["flip"] == figures["hdr_flip"] == 0.0


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("missing.exr", None, "missing.exr: there is no such file"),
        ("text.exr", b"not a picture", "text.exr: is not OpenEXR: expected"),
        ("text.png", b"not a picture", "text.png: is not PNG: expected"),
        ("empty.hdr", b"", "empty.hdr: "),
        ("picture.tif", b"II*\0", "picture.tif: the image cannot be read"),
    ],
)
def test_files_that_cannot_be_read_are_named(
    prtbake: Run, tmp_path: Path, pair: tuple[Path, Path], name: str, content: bytes | None, message: str
) -> None:
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    for order in ((path, pair[1]), (pair[0], path), (*pair, "--mask", path)):
        assert message in sentence(prtbake("compare", *order), tmp_path)


def test_a_folder_in_place_of_a_mask_is_named(prtbake: Run, tmp_path: Path, pair: tuple[Path, Path]) -> None:
    assert "the image cannot be read" in sentence(prtbake("compare", *pair, "--mask", tmp_path), tmp_path)
    assert "found a folder" in sentence(prtbake("compare", *pair, "--mask", tmp_path), tmp_path)


@pytest.mark.parametrize("option", ["--sheet", "--difference-map", "--flip-map", "--hdr-flip-map"])
def test_unwritable_outputs_are_refused_before_the_work(
    prtbake: Run, tmp_path: Path, pair: tuple[Path, Path], option: str
) -> None:
    outcome = prtbake("compare", *pair, option, tmp_path / "none" / "p.png")
    assert "the folder" in sentence(outcome, tmp_path)
    assert not outcome.out
    assert "expected a name that ends in .png" in sentence(
        prtbake("compare", *pair, option, tmp_path / "p.jpg"), tmp_path
    )
