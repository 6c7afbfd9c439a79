"""MP4: what is handed to ffmpeg, and what its absence and its failures say. A script stands in for the program."""

import sys
from pathlib import Path

import numpy as np
import pytest

from formats.errors import ImageError
from formats.image.animation import write_animation
from formats.image.png import to_srgb

KEEPS = """
import sys
with open(sys.argv[-1], "wb") as file:
    file.write(" ".join(sys.argv[1:]).encode() + b"|" + sys.stdin.buffer.read())
"""
FAILS = """
import sys
sys.stdin.buffer.read(10)
sys.exit("Unknown encoder 'libx264'")
"""
WAITS = """
import sys
sys.stdin.buffer.read()
"""
FRAMES = np.random.default_rng(1).random((3, 4, 6, 3)).astype(np.float32)


@pytest.fixture
def ffmpeg(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def stand_in(program: str) -> None:
        script = tmp_path / "bin" / "ffmpeg"
        script.parent.mkdir(exist_ok=True)
        script.write_text(f"#!{sys.executable}\n{program}")
        script.chmod(0o755)
        monkeypatch.setenv("PATH", str(script.parent))

    return stand_in


def test_ffmpeg_gets_every_frame_and_the_rate(tmp_path: Path, ffmpeg) -> None:
    ffmpeg(KEEPS)
    assert write_animation(tmp_path / "turn.mp4", iter(FRAMES), seconds_a_frame=0.05) == 3
    command, _, pixels = (tmp_path / "turn.mp4").read_bytes().partition(b"|")
    assert b"-f rawvideo -pix_fmt rgb24 -s 6x4 -framerate 1000/50 -i - -c:v libx264" in command
    stored = np.frombuffer(pixels, np.uint8).reshape(FRAMES.shape)
    np.testing.assert_array_equal(stored, np.rint(255.0 * to_srgb(FRAMES)))


def test_a_failure_of_ffmpeg_is_named_and_leaves_no_file(tmp_path: Path, ffmpeg) -> None:
    ffmpeg(FAILS)
    large = (np.zeros((512, 512, 3)) for _ in range(20))
    with pytest.raises(
        ImageError, match=r"t.mp4: ffmpeg could not write it \(Unknown encoder 'libx264'\); write .webp"
    ):
        write_animation(tmp_path / "t.mp4", large)
    assert [path.name for path in tmp_path.iterdir()] == ["bin"]


def test_a_failing_frame_stops_ffmpeg(tmp_path: Path, ffmpeg) -> None:
    ffmpeg(WAITS)
    with pytest.raises(ImageError, match=r"frame 1: expected 6x4 pixels as in frame 0, found 8x4"):
        write_animation(tmp_path / "t.mp4", [FRAMES[0], np.zeros((4, 8, 3))])
    with pytest.raises(ImageError, match=r"t.mp4: expected an even width and height in an .mp4, found 5x4 pixels"):
        write_animation(tmp_path / "t.mp4", [np.zeros((4, 5, 3))])
    assert [path.name for path in tmp_path.iterdir()] == ["bin"]


def test_without_ffmpeg_there_is_no_mp4(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(
        ImageError, match=r"t.mp4: the program ffmpeg, which writes .mp4, was not found; install it, or"
    ):
        write_animation(tmp_path / "t.mp4", iter(FRAMES))
    assert not list(tmp_path.iterdir())
