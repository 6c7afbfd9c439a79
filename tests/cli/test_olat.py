"""`prtbake sample --olat` and `prtbake compare` of folders on the command line."""

import json
import math
import os
import signal
from pathlib import Path

import pytest

from prt_bake.olat import render
from prt_bake.olat.score import PictureScore, SetScore
from tests.cli.command_line import SCENE, Run

FEW = ["--views", "1", "--lights", "2", "--test-views", "1", "--test-lights", "1", "--size", "12x12", "--spp", "4"]


def test_a_test_set_is_announced_written_continued_and_scored(prtbake: Run, tmp_path: Path) -> None:
    folder = tmp_path / "ball"
    command = ["sample", "scene.toml", "--olat", "-o", folder, *FEW]
    planned = prtbake(*command, "--dry-run")
    assert planned.code == 0
    assert planned.out.startswith(f"{folder}: 4 pictures of 12x12, about 0.9 MB; about ")
    assert not folder.exists()
    made = prtbake(*command)
    assert made.code == 0
    assert made.err.endswith(f"next: prtbake compare PREDICTED {folder}\n")
    assert f"{folder}: 4 pictures; dataset.json says what they are" in made.out
    readme = (folder / "README.md").read_text()
    assert "prtbake compare PREDICTED ball" in readme
    assert "train 2, test 1, held_out_skies 1" in readme
    report = json.loads((folder / "dataset.json").read_text())
    assert report["complete"]
    assert report["pictures"]["test/v001_l002"]["relative_noise"] > 0.0
    again = prtbake(*command)
    assert again.code == 0
    assert "4 are finished\n" in again.out
    scores = prtbake("compare", folder, folder)
    assert scores.code == 0
    assert "test: 1 pictures" in scores.out
    assert "psnr  inf" in scores.out
    assert "test: the predictions are nearer to the references than their noise, as copies are" in scores.err
    assert "test: an interval needs 8 pictures or more" in scores.err
    as_json = json.loads(prtbake("compare", folder, folder, "--json").out)
    assert as_json["test"]["shares_noise"] is True
    assert as_json["held_out_skies"]["noise_free"]["flip"]["value"] == 0.0
    assert "test: 1 pictures, exposure +0.00 EV" in prtbake("compare", folder, folder, "--exposure", "0").out
    (folder / "test" / "v001_l002.exr").rename(folder / "test" / "lost.exr")
    (folder / "test" / "v001_l002.png").unlink()
    lost = prtbake("compare", folder, folder)
    assert lost.code == 1
    assert "v001_l002.exr: there is no such file" in lost.err
    assert lost.err.count("\n") == 1


def test_a_similarity_of_pictures_that_are_too_small_is_unknown(
    prtbake: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    measured = {"mse": 0.25, "ssim": math.nan, "flip": 0.5}
    scores = {"test": SetScore(0.0, {"test/v001_l002": PictureScore(measured)})}
    monkeypatch.setattr("prt_bake.olat.score.score", lambda *_arguments, **_options: scores)
    printed = prtbake("compare", tmp_path, tmp_path, "--keep-noise").out
    assert "  ssim  unknown: it needs pictures of at least 11x11 pixels" in printed.splitlines()
    assert "nan" not in printed


def test_ctrl_c_keeps_the_finished_pictures(prtbake: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write = render.OlatSet._write

    def write_and_press(*arguments: object) -> None:
        write(*arguments)
        if arguments[1] == tmp_path / "set":
            os.kill(os.getpid(), signal.SIGINT)

    command = ["sample", "scene.toml", "--olat", "-o", tmp_path / "set", *FEW]
    monkeypatch.setattr(render.OlatSet, "_write", write_and_press)
    stopped = prtbake(*command)
    assert stopped.code == 130
    assert "set: stopped; 1 of 4 pictures are finished, and the same command continues" in stopped.err
    monkeypatch.undo()


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("sample scene.toml -o a.h5 --count 1 --views 2", "--views: has no effect without --olat"),
        ("sample scene.toml -o a.h5 --count 1 --dry-run", "--dry-run: has no effect without --olat"),
        ("sample scene.toml -o a.h5", "Missing option '--count'; only --olat works without it"),
        ("sample scene.toml -o a --olat --count 3", "--count: has no effect with --olat"),
        ("sample scene.toml -o a --olat --walks 99", "--walks: has no effect with --olat"),
        ("sample scene.toml -o a --olat --directions 7", "--directions: has no effect with --olat"),
        ("sample scene.toml -o a --olat --force", "--force: has no effect with --olat"),
        ("compare . . --flip-map a.png", "--flip-map is for two images"),
    ],
)
def test_options_of_the_other_kind_are_refused(prtbake: Run, line: str, message: str) -> None:
    outcome = prtbake(*line.split())
    assert outcome.code == 2
    assert message in " ".join(outcome.err.split())


def test_files_in_place_of_folders_are_refused(prtbake: Run, folder: Path, tmp_path: Path) -> None:
    taken = prtbake("sample", "scene.toml", "--olat", "-o", folder, *FEW)
    assert taken.code == 1
    assert f"{folder}: expected a new or empty folder" in taken.err
    under_a_file = prtbake("sample", "scene.toml", "--olat", "-o", folder / "sky.exr" / "set", *FEW)
    assert under_a_file.code == 1
    assert under_a_file.out == ""  # before the pilot
    mixed = prtbake("compare", tmp_path, "sky.exr")
    assert mixed.code == 1
    assert "sky.exr: expected a folder, of a test set" in mixed.err


def test_a_smooth_interface_asks_for_a_light_with_size(prtbake: Run, folder: Path, tmp_path: Path) -> None:
    scene = tmp_path / "smooth.toml"
    scene.write_text(SCENE.replace("eta = 1.0", "eta = 1.5").replace("sphere.ply", str(folder / "sphere.ply")))
    refused = prtbake("sample", scene, "--olat", "-o", tmp_path / "set", *FEW)
    assert refused.code == 1
    assert "add --light-diameter 10 (degrees)" in refused.err
    allowed = prtbake("sample", scene, "--olat", "-o", tmp_path / "set", *FEW, "--light-diameter", 10)
    assert allowed.code == 0
    assert "A disc of 10°" in (tmp_path / "set" / "README.md").read_text()
