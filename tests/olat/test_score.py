"""Scores against known errors: perfect pictures, noise alone, an error beneath noise, and wrong input."""

import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest

from formats.errors import FormatError, QueryError, StorageError
from formats.image import read_layers, write_image
from prt_bake.mathematics.noise_free import Interval
from prt_bake.olat.score import psnr, score

SIGMA, SIDE, COUNT = 0.05, 48, 8


def _truth() -> np.ndarray:
    """A smooth picture [SIDE,SIDE,3]; its object fills all but the border."""
    ramp = np.linspace(0.1, 0.5, SIDE)
    return np.stack([ramp[:, None] + 0 * ramp, ramp + 0 * ramp[:, None], np.full((SIDE, SIDE), 0.3)], axis=2)


def _coverage() -> np.ndarray:
    coverage = np.zeros((SIDE, SIDE))
    coverage[4:-4, 4:-4] = 1.0
    return coverage


def _write(path: Path, picture: np.ndarray, seed: int | None, sigma: float = SIGMA) -> None:
    """A picture on black, with the error layer of `prtbake render` unless the seed is None."""
    path.parent.mkdir(parents=True, exist_ok=True)
    inside = _coverage()[..., None]
    if seed is None:
        return write_image(path, picture * inside)
    noise = np.random.default_rng(seed).normal(0.0, sigma, picture.shape)
    layers = {"error": np.full(picture.shape, sigma) * inside}
    texts = {"prtbake.passes": "16", "prtbake.seed": str(seed), "prtbake.scene": "s"}
    write_image(path, (picture + noise) * inside, alpha=_coverage(), layers=layers, attributes=texts)


@pytest.fixture(scope="module")
def references(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A test set of COUNT noisy pictures of one truth."""
    folder = tmp_path_factory.mktemp("set")
    names = [f"test/v000_l{number:03d}" for number in range(COUNT)]
    (folder / "dataset.json").write_text(json.dumps({"format": "prtbake-olat", "identity": {}}))
    (folder / "transforms_test.json").write_text(json.dumps({"frames": [{"file_path": name} for name in names]}))
    for number, name in enumerate(names):
        _write(folder / f"{name}.exr", _truth(), number)
    return folder


def _predict(folder: Path, picture: np.ndarray, first_seed: int | None) -> Path:
    for number in range(COUNT):
        seed = None if first_seed is None else first_seed + number
        _write(folder / f"test/v000_l{number:03d}.exr", picture, seed)
    return folder


def test_the_references_are_perfect(references: Path) -> None:
    found = score(references, references)["test"]
    for part in (found.measured, found.noise_free):
        assert part("mse").value == part("flip").value == 0.0
        assert part("ssim").value == part("ssim").low == 1.0
    assert psnr(found.measured("mse")).value == math.inf


def test_an_independent_rendering_differs_by_its_noise_alone(references: Path, tmp_path: Path) -> None:
    found = score(_predict(tmp_path, _truth(), 100), references)["test"]
    exposed = (SIGMA * 2.0**found.exposure) ** 2
    assert found.measured("mse").value == pytest.approx(2.0 * exposed, rel=0.05)
    assert found.of_noise("mse") == pytest.approx(2.0 * exposed, rel=1e-3)
    free = found.noise_free("mse")
    assert free.low - 0.02 * exposed < 0.0 < free.high + 0.02 * exposed
    assert abs(free.value) < 0.05 * exposed
    assert found.noise_free("flip").value < 0.5 * found.measured("flip").value
    assert found.noise_free("ssim").value > 0.95 > found.measured("ssim").value
    for metric, perfect in (("flip", 0.0), ("ssim", 1.0)):
        interval = found.noise_free(metric)
        assert interval.low <= perfect + 0.01 * (metric == "flip")
        assert interval.high >= perfect - 0.01
        assert interval.low < interval.high  # the uncertainty of the extrapolation remains


@pytest.mark.parametrize("offset", [0.0, 1e-3])
def test_copies_share_the_noise(references: Path, tmp_path: Path, offset: float) -> None:
    """Exact ones, and ones that another program has written a little differently."""
    for number in range(COUNT):
        path = references / f"test/v000_l{number:03d}.exr"
        image = read_layers(path).image + offset * _coverage()[..., None]
        (tmp_path / "test").mkdir(exist_ok=True)
        write_image(tmp_path / f"test/{path.name}", image)
    assert score(tmp_path, references)["test"].shares_noise()


def test_pictures_of_another_renderer_do_not_share_the_noise(references: Path, tmp_path: Path) -> None:
    assert not score(_predict(tmp_path, _truth(), None), references)["test"].shares_noise()
    assert not score(tmp_path, references, keep_noise=True)["test"].shares_noise()


def test_an_error_beneath_the_noise_is_found(references: Path, tmp_path: Path) -> None:
    offset = 0.6 * SIGMA
    found = score(_predict(tmp_path, _truth() + offset, None), references, exposure=1.0)["test"]
    free = found.noise_free("mse")
    assert found.measured("mse").value == pytest.approx(4.0 * (offset**2 + SIGMA**2), rel=0.05)
    assert free.value == pytest.approx(4.0 * offset**2, rel=0.1)
    assert free.low < free.value < free.high
    assert psnr(free).value == pytest.approx(-20.0 * math.log10(2.0 * offset), abs=0.5)


def test_the_exposure_is_that_of_all_references(references: Path) -> None:
    luminance = np.median(_truth()[_coverage() == 1.0] @ [0.2126, 0.7152, 0.0722])
    found = score(references, references)["test"]
    assert 2.0**found.exposure * luminance == pytest.approx(0.18, rel=0.03)


def _write_pngs(folder: Path, picture: np.ndarray, alpha: np.ndarray | None = None) -> Path:
    (folder / "test").mkdir(parents=True)
    for number in range(COUNT):
        write_image(folder / f"test/v000_l{number:03d}.png", picture, alpha=alpha)
    return folder


def test_the_background_does_not_count_and_png_is_read(references: Path, tmp_path: Path) -> None:
    found = []
    for background in (0.0, 1.0):
        picture = np.where(_coverage()[..., None] == 1.0, _truth(), background)
        found.append(score(_write_pngs(tmp_path / f"{background}", picture), references)["test"])
    assert abs(found[0].noise_free("mse").value) < 0.05 * found[0].measured("mse").value
    for metric in ("mse", "ssim", "flip"):
        assert found[0].measured(metric) == found[1].measured(metric)


def test_colours_of_png_are_multiplied_by_its_alpha(references: Path, tmp_path: Path) -> None:
    half = _write_pngs(tmp_path / "half", 0.5 * _truth(), np.full((SIDE, SIDE), 0.5))
    same = _write_pngs(tmp_path / "same", 0.5 * _truth())
    errors = [score(path, references, keep_noise=True)["test"].measured("mse").value for path in (half, same)]
    assert errors[0] == pytest.approx(errors[1], rel=0.02)


def test_noise_is_kept_on_request(references: Path, tmp_path: Path) -> None:
    found = score(_predict(tmp_path, _truth(), None), references, keep_noise=True)["test"]
    assert math.isnan(found.noise_free("mse").value)
    assert found.measured("mse").value > 0.0


def test_psnr_falls_with_the_error() -> None:
    assert psnr(Interval(0.1, 0.01, 1.0)) == Interval(10.0, 0.0, 20.0)
    assert math.isnan(psnr(Interval(-0.1, -0.2, 1.0)).value)


def _without(path: Path) -> None:
    path.unlink()


def _smaller(path: Path) -> None:
    write_image(path, np.full((SIDE, SIDE - 1, 3), 0.2))


def _nan(path: Path) -> None:
    write_image(path, np.where(_coverage()[..., None] == 1.0, np.nan, _truth()))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (_without, r"l003\.exr: there is no such file, nor a \.png"),
        (_smaller, r"l003\.exr is 47x48, .*l003\.exr 48x48"),
        (_nan, r"of .*l003\.exr are not finite"),
    ],
)
def test_a_wrong_picture_is_named(references: Path, tmp_path: Path, damage, message: str) -> None:
    damage(_predict(tmp_path, _truth(), None) / "test/v000_l003.exr")
    with pytest.raises((QueryError, StorageError), match=message) as raised:
        score(tmp_path, references, keep_noise=True)
    assert str(tmp_path) in str(raised.value)
    assert str(raised.value).count("\n") == 0


def test_the_random_numbers_of_the_reference_are_refused(references: Path, tmp_path: Path) -> None:
    with pytest.raises(QueryError, match="with the random numbers of the reference"):
        score(_predict(tmp_path, _truth() + 0.1, 0), references)


def test_folders_that_are_none(references: Path, tmp_path: Path) -> None:
    with pytest.raises(StorageError, match=r"expected predicted pictures in test/ or held_out_skies/"):
        score(tmp_path, references)
    with pytest.raises(FormatError, match=r"expected the folder of a test set with dataset\.json"):
        score(tmp_path, tmp_path)
    with pytest.raises(QueryError, match=r"is a test set, and .* is none; give the predicted pictures first"):
        score(references, tmp_path)
    small = shutil.copytree(references, tmp_path / "small")
    layers = {"error": np.full((SIDE, SIDE, 3), 0.1)}
    write_image(small / "test/v000_l002.exr", _truth(), alpha=np.full((SIDE, SIDE), 0.5), layers=layers)
    with pytest.raises(FormatError, match=r"l002\.exr: the object covers no pixel completely"):
        score(references, small)
    write_image(small / "test/v000_l002.exr", _truth())
    with pytest.raises(FormatError, match=r"l002\.exr: expected the layers A and error"):
        score(references, small)
    other = shutil.copytree(references, tmp_path / "other")
    (other / "dataset.json").write_text("[]")
    with pytest.raises(FormatError, match="expected a test set"):
        score(references, other)
