"""Progressive rendering: passes, checkpoints, limits of time and noise; and the command."""

import json
import math
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from formats.errors import FormatError, StorageError
from formats.image import read_image, read_layers
from formats.scene import Scene, read_scene
from formats.scene.lights import DirectionalLight
from prt_bake.lights.lighting import Lighting
from prt_bake.rendering.scene import SHOWS, Rendering, render_scene
from prt_bake.rendering.state import (
    Sums,
    checkpoint_path,
    read_checkpoint,
    relative_noise,
    stored_limits,
    write_checkpoint,
)
from tests.cli.command_line import Run
from tests.rendering.pictures import WHITE, front, make_scene, uneven_sky


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return make_scene(tmp_path, "[0.9, 0.7, 0.5]")


def render(scene: Scene, spp: int | None = 64, seed: int = 1, **options) -> Rendering:
    return render_scene(scene, uneven_sky(), options.pop("camera", front(size=8)), spp=spp, seed=seed, **options)


def after(passes: int) -> Callable[[], bool]:
    """A stop callback that returns True after some passes."""
    calls = 0

    def stop() -> bool:
        nonlocal calls
        calls += 1
        return calls >= passes

    return stop


def assert_same(one: Rendering, other: Rendering) -> None:
    np.testing.assert_array_equal(one.image, other.image)
    np.testing.assert_array_equal(one.standard_error, other.standard_error)
    np.testing.assert_array_equal(one.coverage, other.coverage)
    assert (one.walks, one.passes, one.spp) == (other.walks, other.passes, other.spp)


def test_a_resumed_picture_equals_an_uninterrupted_one(scene: Scene, tmp_path: Path) -> None:
    path = tmp_path / "a.render.npz"
    whole = render(scene)
    assert (whole.passes, whole.spp, whole.complete) == (32, 64, True)
    part = render(scene, checkpoint=path, stop=after(5))
    assert (part.passes, part.complete) == (5, False)
    assert_same(part, render(scene, spp=10))
    assert np.isfinite(part.standard_error).all()
    assert part.standard_error.max() > 0
    part = render(scene, spp=40, checkpoint=path, resume=True, stop=after(9))
    assert part.passes == 14 - 1
    whole_again = render(scene, checkpoint=path, resume=True)
    assert_same(whole_again, whole)
    assert path.exists()  # the caller removes it
    assert whole_again.seconds > part.seconds
    seconds, walks, _noise = whole_again.history.T
    assert (np.diff(seconds) > 0).all()
    assert (np.diff(walks) > 0).all()
    assert walks[-1] == whole.walks


def test_more_walks_continue_from_a_checkpoint(scene: Scene, tmp_path: Path) -> None:
    path = tmp_path / "a.render.npz"
    render(scene, spp=32, checkpoint=path, stop=after(4))
    assert_same(render(scene, spp=64, checkpoint=path, resume=True), render(scene, spp=64))
    render(scene, spp=32, checkpoint=path, stop=after(8))
    enough = render(scene, spp=8, checkpoint=path, resume=True)
    assert (enough.passes, enough.complete) == (8, True)


def test_one_pass_has_no_error_estimate(scene: Scene, tmp_path: Path) -> None:
    picture = render(scene, stop=after(1))
    assert picture.passes == 1
    assert np.isinf(picture.standard_error).all()
    assert np.isfinite(picture.image).all()
    assert picture.relative_noise == np.inf


def test_a_picture_that_is_dark_on_average_has_not_converged() -> None:
    """Networks may be slightly negative in the dark."""
    noise, coverage = np.full((4, 4, 3), 0.01), np.ones((4, 4))
    assert relative_noise(np.full((4, 4, 3), 0.1), noise, coverage) == pytest.approx(0.1)
    assert relative_noise(np.full((4, 4, 3), -0.1), noise, coverage) == math.inf
    assert relative_noise(np.zeros((4, 4, 3)), noise, coverage) == 0.0


def test_checkpoints_are_written_regularly(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, seen = tmp_path / "a.render.npz", list[bool]()
    monkeypatch.setattr("prt_bake.rendering.loop._CHECKPOINT_SECONDS", 0.0)
    monkeypatch.setattr("prt_bake.rendering.loop._CHECKPOINT_SHARE", 1e9)
    render(scene, spp=8, checkpoint=path, progress=lambda share: seen.append(path.exists()))
    assert seen == [False, True, True, True]
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.render.npz", "ball.ply", "ball.toml"]


def test_time_and_noise_end_the_work(scene: Scene, tmp_path: Path) -> None:
    quick = render(scene, spp=None, minutes=0.0)
    assert (quick.passes, quick.complete) == (2, True)
    path = tmp_path / "a.render.npz"
    unfinished = render(scene, spp=64, minutes=0.0, checkpoint=path)
    assert (unfinished.passes, unfinished.complete) == (2, False)
    assert path.exists()
    good = render(scene, spp=None, error=0.05)
    assert good.complete
    assert 0.045 < good.relative_noise <= 0.05
    inside = good.coverage == 1
    noise = np.sqrt(np.mean(good.standard_error[inside].astype(np.float64) ** 2))
    assert good.relative_noise == pytest.approx(noise / good.image[inside].mean(), rel=1e-6)
    assert good.history[-1, 2] == pytest.approx(good.relative_noise, rel=1e-5)
    assert render(scene, spp=None, error=1.0).passes == 8


@pytest.mark.statistics
def test_a_black_picture_needs_many_passes_to_count_as_converged(tmp_path: Path) -> None:
    """Behind a smooth interface most passes miss a narrow sun; on a black object all do."""
    smooth = make_scene(tmp_path, eta=1.4)
    narrow = Lighting(suns=(DirectionalLight(np.array([0.0, 0.0, 1.0]), np.ones(3), 12.0),))
    found = render_scene(smooth, narrow, front(size=2), spp=None, error=0.9, seed=1, background=False)
    assert found.passes > 8
    assert not found.black
    coal = make_scene(tmp_path, "0.0", sigma_t=1e4)
    black = render_scene(coal, WHITE, front(size=2), spp=None, error=0.5, background=False)
    assert (black.passes, black.black, black.complete) == (256, True, True)


DIFFERENT = {
    "seed is 1 in the checkpoint, 2 now": {"seed": 2},
    "camera is": {"camera": front((0.0, 0.0, 5.0), 8)},
    r"size is \[8, 8\] in the checkpoint, \[9, 9\] now": {"camera": front(size=9)},
    "the light differs": {"rotate": 1.0},
    "background is true in the checkpoint, false now": {"background": False},
}


@pytest.mark.parametrize("difference", DIFFERENT)
def test_a_checkpoint_of_another_picture_is_refused(scene: Scene, tmp_path: Path, difference: str) -> None:
    path = tmp_path / "a.render.npz"
    render(scene, checkpoint=path, stop=after(2))
    with pytest.raises(FormatError, match=rf"a\.render\.npz: belongs to another picture: {difference}"):
        render(scene, checkpoint=path, resume=True, **DIFFERENT[difference])
    (tmp_path / "ball.toml").write_text((tmp_path / "ball.toml").read_text().replace("0.4", "0.5"))
    with pytest.raises(FormatError, match="the scene differs; repeat the original arguments"):
        render(read_scene(tmp_path / "ball.toml"), checkpoint=path, resume=True)
    assert path.exists()


def test_a_damaged_checkpoint_is_refused(scene: Scene, tmp_path: Path) -> None:
    path = tmp_path / "a.render.npz"
    with pytest.raises(FormatError, match=r"a\.render\.npz: not found; there is nothing to resume"):
        render(scene, checkpoint=path, resume=True)
    render(scene, checkpoint=path, stop=after(2))
    whole = path.read_bytes()
    for content in (b"", b"no archive", whole[: len(whole) // 2], whole[:200] + b"\x00" * 64 + whole[264:]):
        path.write_bytes(content)
        with pytest.raises(FormatError, match="not a readable checkpoint of a picture"):
            read_checkpoint(path, {})
    for arrays in ({"head": np.array("{}")}, {"radiance": np.zeros((8, 8, 3))}):
        np.savez(path, **arrays)
        with pytest.raises(FormatError, match="not a readable checkpoint of a picture"):
            read_checkpoint(path, {})


WRONG_SUMS = {
    "found passes 0": {"passes": 0},
    "found passes -3": {"passes": -3},
    "found passes 2, walks -1": {"walks": -1},
    "seconds nan": {"seconds": float("nan")},
    "coverage is up to 2; expected at most 1, the number of passes": {"passes": 1},
    "radiance has values that are negative or not finite": {"radiance": np.full((8, 8, 3), np.nan)},
    r"radiance has shape \[4, 8, 3\]": {"radiance": np.zeros((4, 8, 3))},
    r"squares has shape \[8, 8\]": {"squares": np.zeros((8, 8))},
    "squares has values that are negative or not finite": {"squares": np.full((8, 8, 3), -1.0)},
    "coverage has values that are negative or not finite": {"coverage": np.full((8, 8), -1.0)},
    r"coverage has shape \[8, 2\]; expected \[8, 8\]": {"coverage": np.zeros((8, 2))},
}


@pytest.mark.parametrize("sentence", WRONG_SUMS)
def test_sums_that_no_passes_have_are_refused(scene: Scene, tmp_path: Path, sentence: str) -> None:
    path = tmp_path / "a.render.npz"
    render(scene, checkpoint=path, stop=after(2))
    with np.load(path) as file:
        arrays = dict(file)
    head = json.loads(str(arrays["head"]))
    for name, value in WRONG_SUMS[sentence].items():
        (arrays if isinstance(value, np.ndarray) else head["numbers"])[name] = value
    np.savez(path, **arrays | {"head": np.array(json.dumps(head))})
    with pytest.raises(FormatError, match=rf"a\.render\.npz: is damaged: .*{sentence}"):
        render(scene, checkpoint=path, resume=True)


def test_the_noise_of_a_single_pass_is_read_back_as_infinite(tmp_path: Path) -> None:
    path, sums = tmp_path / "a.render.npz", Sums.empty(2, 2)
    sums.passes, sums.history = 1, [(0.5, 16.0, np.inf)]
    write_checkpoint(path, sums, {}, {})
    assert read_checkpoint(path, {}).history == [(0.5, 16.0, np.inf)]


def test_a_limit_of_the_last_run_that_is_no_number_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.render.npz"
    write_checkpoint(path, Sums.empty(2, 2), {}, {"spp": 8, "error": None})
    assert stored_limits(path) == {"spp": 8, "error": None}
    write_checkpoint(path, Sums.empty(2, 2), {}, {"spp": "x", "error": None})
    with pytest.raises(FormatError, match=r"a\.render\.npz: is damaged: spp of its last run is 'x'"):
        stored_limits(path)


COMMAND = ["render", "scene.toml", "sphere.ply", "--size", "12x10"]


def test_the_command_writes_layers_attributes_and_a_report(prtbake: Run, tmp_path: Path) -> None:
    output, report = tmp_path / "a.exr", tmp_path / "a.json"
    lights = ["--light", "sky.exr", "--light", "sun:0,1,-1:3,3,2:0.5"]
    outcome = prtbake(*COMMAND, *lights, "-o", output, "--spp", 16, "--seed", 7, "--report", report)
    assert (outcome.code, outcome.err) == (0, "")
    read = read_layers(output)
    np.testing.assert_array_equal(read.image, read_image(output))
    assert read.layers["error"].shape == (10, 12, 3)
    assert read.layers["coverage"].shape == (10, 12)
    assert 0.2 < read.layers["coverage"].mean() < 1.0
    assert read.layers["error"][read.layers["coverage"] == 1].min() > 0
    texts = {name.removeprefix("prtbake."): text for name, text in read.attributes.items()}
    stated = json.loads(report.read_text())
    assert (texts["spp"], texts["seed"], texts["complete"]) == ("16", "7", "yes")
    assert texts["scene"] == read_scene("scene.toml").content_hash
    assert float(texts["seconds"]) == pytest.approx(stated["seconds"], abs=1e-3)
    assert (stated["spp"], stated["passes"], stated["seed"], stated["complete"]) == (16, 8, 7, True)
    assert stated["error_vs_time"]["columns"] == ["seconds", "walks", "relative noise"]
    assert [row[1] for row in stated["error_vs_time"]["rows"]][-1] == stated["walks"]
    assert len(stated["error_vs_time"]["rows"]) == 3
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.exr", "a.json"]


@pytest.mark.parametrize("left_out", [True, False])
def test_the_command_can_leave_out_unscattered_light(prtbake: Run, tmp_path: Path, left_out: bool) -> None:
    output, option = tmp_path / "a.exr", ["--no-unscattered"] if left_out else []
    assert prtbake(*COMMAND, "--light", "sky.exr", "-o", output, "--spp", 2, *option).code == 0
    shows = read_layers(output).attributes["prtbake.shows"]
    assert shows == SHOWS["scattered" if left_out else "all"]


@pytest.mark.parametrize("options", [["--minutes", "0"], ["--error", "0.5"], []])
def test_the_command_ends_on_time_noise_or_its_default_walks(prtbake: Run, tmp_path: Path, options: list[str]) -> None:
    outcome = prtbake(*COMMAND, "--light", "sky.exr", "-o", tmp_path / "a.exr", *options)
    assert outcome.code == 0
    expected = {"--minutes": "4", "--error": "16"}.get(options[0] if options else "", "64")
    assert read_layers(tmp_path / "a.exr").attributes["prtbake.spp"] == expected
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr"]


def test_out_of_time_the_command_says_how_to_resume(prtbake: Run, tmp_path: Path) -> None:
    picture = [*COMMAND, "--light", "sky.exr", "-o", tmp_path / "a.exr", "--spp", 8]
    outcome = prtbake(*picture, "--minutes", 0)
    assert outcome.code == 0
    assert "the time limit ended after 4 paths per pixel; --resume continues" in outcome.err
    assert read_layers(tmp_path / "a.exr").attributes["prtbake.complete"] == "no"
    refused = prtbake(*picture, "--resume", "--seed", 3)
    assert refused.code == 1
    assert refused.err.startswith(
        f"prtbake: {tmp_path}/a.exr.render.npz: belongs to another picture: seed is 0 in the checkpoint, 3"
    )
    again = prtbake(*picture[:-2], "--resume")  # with the previous limits: 8 walks, 0 minutes
    assert "the time limit ended after 4 paths per pixel" in again.err
    assert prtbake(*picture, "--resume").code == 0
    assert read_layers(tmp_path / "a.exr").attributes["prtbake.spp"] == "8"
    resumed = read_image(tmp_path / "a.exr")
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr"]
    assert prtbake(*picture).code == 0
    np.testing.assert_array_equal(read_image(tmp_path / "a.exr"), resumed)


def full_disk(path: Path, *_: object, **__: object) -> None:
    raise StorageError(f"{path}: no space left on the device")


def test_a_picture_can_be_resumed_after_a_failed_write(
    prtbake: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("prt_bake.rendering.loop._CHECKPOINT_SECONDS", 0.0)
    picture = [*COMMAND, "--light", "sky.exr", "-o", tmp_path / "a.exr", "--spp", 8]
    with monkeypatch.context() as patched:
        patched.setattr("formats.image.write_image", full_disk)
        assert prtbake(*picture).code == 1
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr.render.npz"]
    assert prtbake(*picture, "--resume").code == 0
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr"]


def test_pictures_of_the_same_name_have_separate_checkpoints(prtbake: Run, tmp_path: Path) -> None:
    start = [*COMMAND, "--light", "sky.exr"]
    assert prtbake(*start, "-o", tmp_path / "a.exr", "--spp", 8, "--minutes", 0).code == 0
    assert prtbake(*start, "-o", tmp_path / "a.png", "--spp", 2).code == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.exr", "a.exr.render.npz", "a.png"]


def test_missing_and_invalid_lights_are_refused_in_one_sentence(prtbake: Run, tmp_path: Path) -> None:
    assert prtbake(*COMMAND, "-o", tmp_path / "a.exr").code == 2
    (tmp_path / "lights.toml").write_text("[[directional]]\ndirection = [0, 1, 0]\ncolour = [1, 1, 1]\n")
    (tmp_path / "smooth.toml").write_text(
        Path("scene.toml").read_text().replace("eta = 1.0", "eta = 1.5").replace('"sphere', f'"{Path.cwd()}/sphere')
    )
    cases = {
        "directional.0.colour: unknown key": ["--light", tmp_path / "lights.toml"],
        "direction: expected three": ["--light", "sun:0,0,0"],
        "irradiance: expected three": ["--light", "sun:0,1,0:-1,1,1"],
        "angular diameter: expected degrees": ["--light", "sun:0,1,0:-1"],
        "there is no such file": ["--light", "none.hdr"],
        "nothing to resume": ["--light", "sky.exr", "--resume"],
    }
    for sentence, options in cases.items():
        outcome = prtbake(*COMMAND, "-o", tmp_path / "a.exr", *options)
        assert (outcome.code, len(outcome.err.splitlines())) == (1, 1), sentence
        assert sentence in outcome.err
    smooth = ["render", tmp_path / "smooth.toml", "sphere.ply", "-o", tmp_path / "a.exr", "--light", "sun:0,1,0"]
    outcome = prtbake(*smooth)
    assert (outcome.code, len(outcome.err.splitlines())) == (1, 1)
    assert "give the light an angular diameter" in outcome.err
    assert not (tmp_path / "a.exr").exists()


@pytest.mark.usefixtures("compiled_kernels")
def test_ctrl_c_leaves_a_valid_picture_that_can_be_resumed(prtbake: Run, folder: Path, tmp_path: Path) -> None:
    program = (
        "import sys; from prt_bake.cli import main; from prt_bake.cli.shared import progress; "
        "progress.PLAIN_INTERVAL = 0.0; sys.exit(main.main(sys.argv[1:]))"
    )
    command = [*COMMAND, "--light", "sky.exr", "-o", str(tmp_path / "a.exr")]
    started = [sys.executable, "-c", program, *command, "--spp", "1000000"]
    process = subprocess.Popen(started, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    for _ in range(3):
        assert "1000000 paths per pixel" in process.stderr.readline()
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=600)
    assert process.returncode == 130
    assert "Traceback" not in err
    assert "stopped" in err.splitlines()[-1]
    read = read_layers(tmp_path / "a.exr")
    spp = int(read.attributes["prtbake.spp"])
    assert 4 <= spp < 1000000
    assert read.attributes["prtbake.complete"] == "no"
    assert np.isfinite(read.layers["error"]).all()
    assert checkpoint_path(tmp_path / "a.exr").is_file()
    done = prtbake(*command, "--resume", "--spp", spp + 2)
    assert done.code == 0, done.err
    assert read_layers(tmp_path / "a.exr").attributes["prtbake.spp"] == str(spp + 2)
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr"]
