"""`prtbake compare` of pictures with an alpha channel: what is transparent in both is no agreement."""

import json
from pathlib import Path

import numpy as np
import pytest

from formats.image import write_image
from tests.cli.command_line import Run

SHAPE = (24, 32)
OPAQUE = np.zeros(SHAPE)
OPAQUE[4:20, 6:26] = 1.0
EDGE = OPAQUE.copy()
EDGE[4, 6:26] = 0.5


def save(folder: Path, name: str, factor: float, alpha: np.ndarray | None = None, **layers: np.ndarray) -> Path:
    """A picture, weighted by an alpha, whose colour beneath is noise times `factor`."""
    image = factor * np.random.default_rng(3).uniform(0.2, 0.8, (*SHAPE, 3))
    write_image(folder / name, image if alpha is None else image * alpha[..., None], alpha=alpha, layers=layers)
    return folder / name


def figures(prtbake: Run, *arguments: object) -> tuple[dict, str]:
    outcome = prtbake("compare", *arguments, "--json")
    assert outcome.code == 0, outcome.err
    return json.loads(outcome.out), outcome.err


@pytest.mark.parametrize("suffix", [".png", ".exr"])
def test_what_is_transparent_in_both_does_not_count(prtbake: Run, tmp_path: Path, suffix: str) -> None:
    pair = [save(tmp_path, f"{name}{suffix}", factor, OPAQUE) for name, factor in (("a", 1.1), ("b", 1.0))]
    told, said = figures(prtbake, *pair)
    assert told["pixels"] == OPAQUE.sum()
    assert f"{(OPAQUE == 0).sum()} of {OPAQUE.size} pixels are transparent in both pictures, and do not count" in said
    image = save(tmp_path, "c.exr", 1.1), save(tmp_path, "d.exr", 1.0)
    write_image(tmp_path / "mask.png", np.repeat(OPAQUE[..., None], 3, axis=2))
    masked, _ = figures(prtbake, *image, "--mask", tmp_path / "mask.png")
    assert told["mse"] == pytest.approx(masked["mse"], rel=0.05)


def test_what_one_of_two_pictures_shows_counts(prtbake: Run, tmp_path: Path) -> None:
    shifted = np.roll(OPAQUE, 3, axis=1)
    pair = save(tmp_path, "a.exr", 1.0, OPAQUE), save(tmp_path, "b.exr", 1.0, shifted)
    assert figures(prtbake, *pair)[0]["pixels"] == np.maximum(OPAQUE, shifted).sum()


def test_colours_of_a_png_are_weighted_by_its_alpha_as_those_of_an_exr(prtbake: Run, tmp_path: Path) -> None:
    pair = save(tmp_path, "a.png", 1.0, EDGE), save(tmp_path, "b.exr", 1.0, EDGE)
    assert figures(prtbake, *pair)[0]["relative_rmse"] < 0.01


@pytest.mark.parametrize("suffix", [".png", ".exr"])
def test_an_alpha_that_is_left_out_is_told_and_can_be_the_mask(prtbake: Run, tmp_path: Path, suffix: str) -> None:
    clear, whole = save(tmp_path, f"a{suffix}", 1.1, OPAQUE), save(tmp_path, "b.exr", 1.0)
    told, said = figures(prtbake, clear, whole)
    assert told["pixels"] == OPAQUE.size
    assert f"{clear}: its alpha channel is left out" in said
    assert f"--mask {clear} counts what is opaque alone" in said
    told, said = figures(prtbake, clear, whole, "--mask", clear)
    assert told["pixels"] == OPAQUE.sum()
    assert told["relative_rmse"] == pytest.approx(0.1, rel=0.05)
    assert f"{clear}: its alpha channel is the mask" in said
    assert "left out" not in said


@pytest.mark.parametrize("alpha", [np.ones(SHAPE), np.zeros(SHAPE)])
def test_pictures_that_are_opaque_or_transparent_everywhere_count_whole(
    prtbake: Run, tmp_path: Path, alpha: np.ndarray
) -> None:
    pair = save(tmp_path, "a.png", 1.0, alpha), save(tmp_path, "b.png", 1.0, alpha)
    told, said = figures(prtbake, *pair)
    assert told["pixels"] == OPAQUE.size
    assert ("left out" in said) == (not alpha.any())


@pytest.mark.parametrize("suffix", [".png", ".exr"])
def test_a_mask_that_is_opaque_is_one_by_its_colour(prtbake: Run, tmp_path: Path, suffix: str) -> None:
    pair, mask = (save(tmp_path, "a.exr", 1.1), save(tmp_path, "b.exr", 1.0)), tmp_path / f"mask{suffix}"
    write_image(mask, np.repeat(OPAQUE[..., None], 3, axis=2), alpha=np.ones(SHAPE))
    told, said = figures(prtbake, *pair, "--mask", mask)
    assert told["pixels"] == OPAQUE.sum()
    assert said == ""
