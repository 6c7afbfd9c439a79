"""Animations and numbered images: another decoder reads every frame that was written."""

import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image, ImageSequence

from formats.errors import ImageError, InputWarning, StorageError
from formats.image import read_image
from formats.image.animation import write_animation, write_sequence
from formats.image.png import to_srgb


def levels(frame: np.ndarray, exposure: float = 0.0) -> np.ndarray:
    """The frame as 8-bit sRGB."""
    return np.rint(255.0 * to_srgb(frame * 2.0**exposure)).astype(np.uint8)


def read(path: Path) -> tuple[list[np.ndarray], list[float]]:
    """The frames and their durations in milliseconds."""
    with Image.open(path) as picture:
        assert picture.info.get("loop") == 0
        frames, times = [], []
        for frame in ImageSequence.Iterator(picture):
            frames.append(np.asarray(frame.convert("RGB")))
            times.append(frame.info["duration"])
    return frames, times


@settings(max_examples=30, deadline=None)
@given(
    st.integers(1, 5).flatmap(
        lambda count: arrays(np.float32, (count, 3, 4, 3), elements=st.floats(-0.25, 1.5, width=32))
    ),
    st.floats(-3.0, 3.0),
    st.integers(10, 2000),
    st.sampled_from([".png", ".webp"]),
)
def test_frames_survive_write_and_read(
    tmp_path_factory: pytest.TempPathFactory, frames: np.ndarray, exposure: float, milliseconds: int, suffix: str
) -> None:
    path = tmp_path_factory.mktemp("turn") / f"turn{suffix}"
    # Equal consecutive frames would be merged.
    frames[:, 0, 0, 0] = np.arange(len(frames)) / 8.0 * 2.0**-exposure
    count = write_animation(path, iter(frames), exposure=exposure, seconds_a_frame=milliseconds / 1000.0)
    assert count == len(frames)
    expected = [levels(frame, exposure) for frame in frames]
    with Image.open(path) as picture:
        assert getattr(picture, "n_frames", 1) == count
        np.testing.assert_array_equal(np.asarray(picture.convert("RGB")), expected[0])
    if count > 1:
        found, times = read(path)
        np.testing.assert_array_equal(found, expected)
        assert times == pytest.approx([milliseconds] * count)


def test_a_gif_stores_every_frame_to_its_palette(tmp_path: Path) -> None:
    steps = np.linspace(0.0, 1.0, 12)
    frames = [np.full((6, 8, 3), step) * [1.0, 0.5, 0.25] for step in steps]
    assert write_animation(tmp_path / "turn.gif", frames, seconds_a_frame=0.05) == 12
    found, times = read(tmp_path / "turn.gif")
    assert sum(times) == 600
    np.testing.assert_allclose(found, [levels(frame) for frame in frames], atol=4)


def test_the_first_frame_of_an_apng_is_a_png(tmp_path: Path) -> None:
    frames = np.random.default_rng(1).uniform(size=(3, 5, 7, 3))
    write_animation(tmp_path / "turn.png", frames)
    with pytest.warns(InputWarning, match="turn.png: is an animation; its first picture is read"):
        found = read_image(tmp_path / "turn.png")
    np.testing.assert_allclose(to_srgb(found), levels(frames[0]) / 255.0, atol=1e-6)


@pytest.mark.parametrize("suffix", [".png", ".webp"])
def test_memory_does_not_grow_with_the_number_of_frames(tmp_path: Path, suffix: str) -> None:
    def frames(count: int) -> Iterator[np.ndarray]:
        for n in range(count):
            yield np.random.default_rng(n).uniform(size=(64, 64, 3))

    def peak(count: int) -> int:
        tracemalloc.start()
        write_animation(tmp_path / f"turn{suffix}", frames(count))
        found = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return found

    peak(2)
    assert peak(60) < peak(6) + 3 * 64 * 64 * 3 * 8 * (1 if suffix == ".png" else 3)


def test_an_error_keeps_the_older_file(tmp_path: Path) -> None:
    path = tmp_path / "turn.png"
    path.write_bytes(b"older")

    def failing() -> Iterator[np.ndarray]:
        yield np.zeros((4, 4, 3))
        raise RuntimeError("no more")

    with pytest.raises(RuntimeError, match="no more"):
        write_animation(path, failing())
    assert path.read_bytes() == b"older"
    assert [each.name for each in tmp_path.iterdir()] == ["turn.png"]


NAN = np.full((4, 4, 3), 0.5)
NAN[2, 1, 0] = np.nan


@pytest.mark.parametrize(
    ("name", "frames", "seconds", "sentence"),
    [
        ("turn.avi", [np.zeros((4, 4, 3))], 0.1, "expected an animation .png, .webp, .gif or .mp4, found '.avi'"),
        ("turn.png", [], 0.1, "has no frames"),
        ("turn.webp", [], 0.1, "has no frames"),
        (
            "turn.png",
            [np.zeros((4, 4, 3)), np.zeros((4, 5, 3))],
            0.1,
            "frame 1: expected 4x4 pixels as in frame 0, found 5x4",
        ),
        ("turn.gif", [np.zeros((4, 4, 3)), NAN], 0.1, "frame 1: pixels are NaN, the first in row 2"),
        ("turn.png", [np.zeros((4, 4))], 0.1, r"frame 0: expected shape \[H,W,3\], found \[4, 4\]"),
        ("turn.png", [np.zeros((4, 4, 3))], 0.0, "seconds a frame: expected 0.01 to 60, found 0"),
        ("turn.png", [np.zeros((4, 4, 3))], np.nan, "seconds a frame: .* found nan"),
        ("turn.webp", [np.zeros((1, 16384, 3))], 0.1, "at most 16383 along a side"),
    ],
)
def test_invalid_frames_and_settings_are_refused(
    tmp_path: Path, name: str, frames: list[np.ndarray], seconds: float, sentence: str
) -> None:
    with pytest.raises(ImageError, match=sentence):
        write_animation(tmp_path / name, frames, seconds_a_frame=seconds)
    assert not list(tmp_path.iterdir())


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="does not exist"):
        write_animation(tmp_path / "none" / "turn.png", [np.zeros((4, 4, 3))])


@pytest.mark.filterwarnings("ignore:.*exposure of -1 EV")
@pytest.mark.parametrize("suffix", [".png", ".exr"])
def test_a_sequence_is_numbered_from_0(tmp_path: Path, suffix: str) -> None:
    frames = np.random.default_rng(2).uniform(size=(3, 4, 5, 3)).astype(np.float32)
    paths = write_sequence(tmp_path / f"turn_%03d{suffix}", iter(frames), exposure=-1.0)
    assert [path.name for path in paths] == [f"turn_{n:03d}{suffix}" for n in range(3)]
    for path, frame in zip(paths, frames, strict=True):
        expected = frame if suffix == ".exr" else levels(frame, -1.0) / 255.0
        found = read_image(path)
        np.testing.assert_allclose(found if suffix == ".exr" else to_srgb(found), expected, atol=1e-6)


@pytest.mark.parametrize("pattern", ["turn.png", "turn_%d_%d.png", "turn_%s.png", "100%_%03d.png"])
def test_a_name_without_one_number_is_refused(tmp_path: Path, pattern: str) -> None:
    with pytest.raises(ImageError, match="a name with one number in it"):
        write_sequence(tmp_path / pattern, [np.zeros((4, 4, 3))])
    with pytest.raises(ImageError, match="has no frames"):
        write_sequence(tmp_path / "turn_%d.png", [])
