"""`prtbake compare` of pictures with an alpha channel: pixels that are transparent in both are ignored."""

import json
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from formats.image import write_image
from tests.cli.command_line import Run

SHAPE = (24, 32)
OPAQUE = np.zeros(SHAPE)
OPAQUE[4:20, 6:26] = 1.0
EDGE = OPAQUE.copy()
EDGE[4, 6:26] = 0.5


def save(folder: Path, name: str, factor: float, alpha: np.ndarray | None = None, **layers: np.ndarray) -> Path:
    """Write `factor` times random colours, premultiplied by an alpha."""
    image = factor * np.random.default_rng(3).uniform(0.2, 0.8, (*SHAPE, 3))
    write_image(folder / name, image if alpha is None else image * alpha[..., None], alpha=alpha, layers=layers)
    return folder / name


def figures(prtbake: Run, *arguments: object) -> tuple[dict, str]:
    outcome = prtbake("compare", *arguments, "--json")
    assert outcome.code == 0, outcome.err
    return json.loads(outcome.out), outcome.err


def test_an_alpha_that_is_not_a_number_is_not_transparent(prtbake: Run, tmp_path: Path) -> None:
    first = save(tmp_path, "a.exr", 1.1, OPAQUE)
    channels = {name: channel.pixels for name, channel in OpenEXR.File(str(first)).channels().items()}
    channels["RGBA"] = np.ascontiguousarray(channels["RGBA"])
    channels["RGBA"][0, 0, 3] = np.nan
    OpenEXR.File({"type": OpenEXR.scanlineimage}, channels).write(str(first))
    values, _ = figures(prtbake, first, save(tmp_path, "b.exr", 1.0, OPAQUE))
    assert values["pixels"] == OPAQUE.sum() + 1


@pytest.mark.parametrize("suffix", [".png", ".exr"])
def test_pixels_transparent_in_both_are_ignored(prtbake: Run, tmp_path: Path, suffix: str) -> None:
    pair = [save(tmp_path, f"{name}{suffix}", factor, OPAQUE) for name, factor in (("a", 1.1), ("b", 1.0))]
    values, message = figures(prtbake, *pair)
    assert values["pixels"] == OPAQUE.sum()
    assert f"{(OPAQUE == 0).sum()} of {OPAQUE.size} pixels are transparent in both images and are ignored" in message
    image = save(tmp_path, "c.exr", 1.1), save(tmp_path, "d.exr", 1.0)
    write_image(tmp_path / "mask.png", np.repeat(OPAQUE[..., None], 3, axis=2))
    masked, _ = figures(prtbake, *image, "--mask", tmp_path / "mask.png")
    assert values["mse"] == pytest.approx(masked["mse"], rel=0.05)


def test_pixels_visible_in_one_picture_are_compared(prtbake: Run, tmp_path: Path) -> None:
    shifted = np.roll(OPAQUE, 3, axis=1)
    pair = save(tmp_path, "a.exr", 1.0, OPAQUE), save(tmp_path, "b.exr", 1.0, shifted)
    assert figures(prtbake, *pair)[0]["pixels"] == np.maximum(OPAQUE, shifted).sum()


def test_a_png_is_premultiplied_like_an_exr(prtbake: Run, tmp_path: Path) -> None:
    pair = save(tmp_path, "a.png", 1.0, EDGE), save(tmp_path, "b.exr", 1.0, EDGE)
    assert figures(prtbake, *pair)[0]["relative_rmse"] < 0.01


@pytest.mark.parametrize("suffix", [".png", ".exr"])
def test_an_ignored_alpha_is_reported_and_can_be_the_mask(prtbake: Run, tmp_path: Path, suffix: str) -> None:
    clear, opaque = save(tmp_path, f"a{suffix}", 1.1, OPAQUE), save(tmp_path, "b.exr", 1.0)
    values, message = figures(prtbake, clear, opaque)
    assert values["pixels"] == OPAQUE.size
    assert f"{clear}: the alpha channel is ignored" in message
    assert f"--mask {clear} compares the opaque pixels alone" in message
    values, message = figures(prtbake, clear, opaque, "--mask", clear)
    assert values["pixels"] == OPAQUE.sum()
    assert values["relative_rmse"] == pytest.approx(0.1, rel=0.05)
    assert f"{clear}: the alpha channel is used as the mask" in message
    assert "is ignored" not in message


@pytest.mark.parametrize("alpha", [np.ones(SHAPE), np.zeros(SHAPE)])
def test_all_pixels_of_fully_opaque_or_transparent_pictures_are_compared(
    prtbake: Run, tmp_path: Path, alpha: np.ndarray
) -> None:
    pair = save(tmp_path, "a.png", 1.0, alpha), save(tmp_path, "b.png", 1.0, alpha)
    values, message = figures(prtbake, *pair)
    assert values["pixels"] == OPAQUE.size
    assert ("is ignored" in message) == (not alpha.any())


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_a_mask_is_data(prtbake: Run, tmp_path: Path, suffix: str) -> None:
    """Grey of code 150 is more than half white. As a colour in sRGB it would be 0.3."""
    pair, mask = (save(tmp_path, "a.exr", 1.1), save(tmp_path, "b.exr", 1.0)), tmp_path / f"mask{suffix}"
    codes = np.where(np.arange(SHAPE[1]) < 16, 150, 100).astype(np.uint8)
    Image.fromarray(np.broadcast_to(codes, SHAPE)).save(mask)
    assert figures(prtbake, *pair, "--mask", mask)[0]["pixels"] == SHAPE[0] * 16


@pytest.mark.parametrize("kind", ["gamma.png", "linear.exr"])
@pytest.mark.parametrize("with_alpha", [True, False])
def test_what_a_mask_says_about_colours_is_no_remark(prtbake: Run, tmp_path: Path, kind: str, with_alpha: bool) -> None:
    pair, mask = (save(tmp_path, "a.exr", 1.1), save(tmp_path, "b.exr", 1.0)), tmp_path / kind
    if mask.suffix == ".png":
        chosen = np.uint8(255 * OPAQUE)
        gamma = PngInfo()
        gamma.add(b"gAMA", (100_000).to_bytes(4, "big"))
        grey = Image.fromarray(np.stack([chosen, chosen], axis=2), "LA") if with_alpha else Image.fromarray(chosen)
        grey.save(mask, pnginfo=gamma)
    else:
        ap0 = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)
        channels = dict.fromkeys("RGBA" if with_alpha else "RGB", np.float32(OPAQUE))
        OpenEXR.File({"chromaticities": ap0, "type": OpenEXR.scanlineimage}, channels).write(str(mask))
    values, message = figures(prtbake, *pair, "--mask", mask)
    assert values["pixels"] == OPAQUE.sum()
    assert message == (f"prtbake: {mask}: the alpha channel is used as the mask\n" if with_alpha else "")


@pytest.mark.parametrize("suffix", [".png", ".exr"])
def test_an_opaque_mask_is_read_by_its_colour(prtbake: Run, tmp_path: Path, suffix: str) -> None:
    pair, mask = (save(tmp_path, "a.exr", 1.1), save(tmp_path, "b.exr", 1.0)), tmp_path / f"mask{suffix}"
    write_image(mask, np.repeat(OPAQUE[..., None], 3, axis=2), alpha=np.ones(SHAPE))
    values, message = figures(prtbake, *pair, "--mask", mask)
    assert values["pixels"] == OPAQUE.sum()
    assert message == ""
