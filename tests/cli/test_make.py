"""`prtbake make`: its steps and times, with commands that only write their files and turn a clock."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated

import pytest
import trimesh
import typer

from formats.errors import PrtbakeError
from formats.mesh import build_mesh, flipped, read_mesh, write_mesh
from prt_bake.cli.main import main as prtbake
from prt_bake.cli.making import steps
from prt_bake.cli.making.make import make
from prt_bake.cli.making.record import only_run
from prt_bake.cli.shared import signals
from prt_bake.cli.shared.next_step import say_next

SECONDS = {"train": 660.0, "bake": 200.0, "picture": 8.0, "turntable": 20.0}


class Kitchen:
    """Commands that write their files, how long each takes, and one that fails after it has written half."""

    def __init__(self, asset):
        self.asset, self.seconds, self.now = asset, dict(SECONDS), 0.0
        self.calls, self.broken, self.slow, self.frame, self.part = [], "", False, 4.0, 1.0
        self.app = typer.Typer()
        for command in (make, self.train, self.bake, self.shade):
            self.app.command(command.__name__)(command)

    def run(self, *arguments):
        self.calls = []
        self.app(args=["make", *map(str, arguments)], standalone_mode=False)
        return self.calls

    def finish(self, name, output, *facts):
        self.calls.append((name, *facts))
        self.now += self.part * self.seconds[name]
        output.write_bytes(b"half")
        if name == self.broken:
            Path(f"{output}.journal").mkdir(exist_ok=True)
            raise PrtbakeError(f"{name}: stopped")
        if name == "bake":
            shutil.copy(self.asset, output)

    def train(
        self,
        scene: Path,
        output: Annotated[Path, typer.Option("-o")],
        minutes: float = 0.0,
        resume: Annotated[bool, typer.Option("--resume")] = False,
    ) -> None:
        output.with_name("model.train.pt").write_bytes(b"state")
        self.finish("train", output, minutes, resume)
        output.with_name("model.report.html").write_text("report")
        say_next("prtbake", "bake", output)

    def bake(
        self,
        source: Path,
        mesh: Path,
        output: Annotated[Path, typer.Option("-o")],
        error: float = 0.0,
        minutes: float = 0.0,
        workers: int = 1,
        resume: Annotated[bool, typer.Option("--resume")] = False,
        rings: int = 16,
        sectors: int = 64,
        samples: int = 64,
        lobes: int = 4,
    ) -> None:
        assert source.is_file()
        assert mesh.is_file()
        if self.slow and minutes:
            self.calls.append(("bake", error, minutes, resume))
            self.now += 60.0 * minutes
            Path(f"{output}.journal").mkdir()
            raise PrtbakeError("nothing was written")
        assert resume or not Path(f"{output}.journal").exists()
        self.finish("bake", output, rings if self.slow else error, minutes, resume)

    def shade(
        self,
        asset: Path,
        light: Annotated[list[str], typer.Option("--light")],
        output: Annotated[Path, typer.Option("-o")],
        size: str = "",
        turntable: str = "",
        frames: int = 0,
        seconds: float = 0.0,
        reflection: Annotated[bool, typer.Option("--reflection")] = False,
        samples: int = 3,
        tone_map: str = "none",
        exposure: float = 0.0,
        view: str = "",
    ) -> None:
        assert reflection
        assert seconds == (3.0 if turntable else 0.0)
        shown = (tone_map, exposure, view)
        self.finish("turntable" if turntable else "picture", output, frames, *map(str, light), *shown)


@pytest.fixture(scope="session")
def asset(folder):
    return folder / "asset.h5"


@pytest.fixture
def kitchen(asset, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ball = trimesh.creation.icosphere(subdivisions=1)
    write_mesh(build_mesh(ball.vertices, ball.faces), tmp_path / "ball.obj")
    assert prtbake(["init", "ball.obj", "--material", "wax", "--size", "5cm", "-o", "wax.toml"]) == 0
    cook = Kitchen(asset)
    monkeypatch.setattr(steps, "time", SimpleNamespace(monotonic=lambda: cook.now))
    monkeypatch.setattr(steps, "_frame_seconds", lambda asset, lights: cook.frame)
    monkeypatch.setattr(steps, "_quality", lambda model: "the network is 9.0 % off")
    return cook


def summary():
    return json.loads(Path("out/summary.json").read_text())


def test_the_steps_share_the_time(kitchen, capsys):
    calls = kitchen.run("wax.toml", "-o", "out", "--minutes", "20")
    assert [call[0] for call in calls] == ["train", "bake", "picture", "turntable"]
    assert calls[0][1:] == (11.0, False)
    assert calls[1][1:] == (0.02, 7.0, False)  # 20 minutes less 11 of training and 2 for the rest
    assert calls[2][2].endswith("sky.hdr")
    assert calls[2][3:] == ("sun:0.6,0.6,-0.6:2,1.9,1.7:3", "agx", 0.0, "")
    assert calls[3][1] == 41  # frames: half of the 332 s that are left, 4 s each
    found = summary()
    assert [step["name"] for step in found["steps"]] == ["train", "bake", "picture", "turntable", "compress"]
    assert found["spent"] == sum(SECONDS.values())
    assert found["steps"][0]["files"].keys() == {"model.pt", "model.report.html"}
    assert found["figures"]["vertices"] == 42
    page = Path("out/summary.md").read_text()
    assert "    prtbake train wax.toml -o out/model.pt --minutes 11\n" in page
    assert "    prtbake bake out/model.pt ball.obj -o out/asset.h5 --workers" in page
    assert "![picture.png](picture.png)" in page
    captured = capsys.readouterr()
    assert captured.out.startswith("out/summary.md: error of the asset ")
    assert "out/asset.h5: " in captured.out
    assert "the same asset, to pass on: coefficients at most 0.5 % off" in captured.out
    assert "out/model.pt: the network is 9.0 % off" in captured.err
    assert "next: prtbake view out/asset.h5" in captured.err.splitlines()[-1]
    assert captured.err.count("next: ") == 1


def test_finished_steps_are_not_done_again(kitchen, capsys):
    kitchen.run("wax.toml", "-o", "out", "--light", "sun:0,1,0")
    assert kitchen.run("wax.toml", "-o", "out", "--light", "sun:0,1,0") == []
    assert "train: done already, in 11:00 min" in capsys.readouterr().err
    Path("out/asset.h5").unlink()
    calls = kitchen.run("wax.toml", "-o", "out", "--light", "sun:0,1,0")
    assert [call[0] for call in calls] == ["bake", "picture", "turntable"]
    assert calls[1] == ("picture", 0, "sun:0,1,0", "agx", 0.0, "")


def test_a_stopped_training_is_resumed(kitchen, capsys):
    kitchen.broken = "train"
    with pytest.raises(PrtbakeError, match="train: stopped"):
        kitchen.run("wax.toml", "-o", "out")
    assert "train was not finished; the same `prtbake make` continues there" in capsys.readouterr().err
    kitchen.broken = ""
    assert kitchen.run("wax.toml", "-o", "out")[0] == ("train", 11.0, True)


def test_a_stopped_bake_is_resumed_with_the_time_that_is_left(kitchen, capsys):
    kitchen.broken = "bake"
    with pytest.raises(PrtbakeError, match="bake: stopped"):
        kitchen.run("wax.toml", "-o", "out")
    kitchen.broken, kitchen.seconds["bake"] = "", 100.0
    capsys.readouterr()
    calls = kitchen.run("wax.toml", "-o", "out")
    assert [call[0] for call in calls] == ["bake", "picture", "turntable"]
    assert calls[0] == ("bake", 0.02, 3.67, True)  # 7 minutes less 200 s
    assert "bake, 5:40 min left of 20:00 min" in capsys.readouterr().err
    assert "--resume" not in Path("out/summary.md").read_text()
    assert summary()["steps"][1]["seconds"] == 300.0
    assert summary()["spent"] == 988.0


def test_time_that_is_lost_is_taken_from_all_steps(kitchen):
    """A training that was stopped before it had a checkpoint begins again."""
    kitchen.broken, kitchen.part = "train", 1.0 / 3.0
    with pytest.raises(PrtbakeError, match="train: stopped"):
        kitchen.run("wax.toml", "-o", "out")
    Path("out/model.train.pt").unlink()
    record = json.loads(Path("out/summary.json").read_text())
    Path("out/summary.json").write_text(json.dumps(record | {"unfinished": {}}))
    kitchen.broken, kitchen.part = "", 1.0
    assert kitchen.run("wax.toml", "-o", "out")[0] == ("train", 8.98, False)  # 55 % of 20 minutes less 220 s


def test_more_minutes_train_on(kitchen, capsys):
    kitchen.run("wax.toml", "-o", "out", "--minutes", "16")
    kitchen.seconds["train"] = 300.0
    Path("out/model.report.json").write_text("the report of the shorter training")
    calls = kitchen.run("wax.toml", "-o", "out", "--minutes", "30")
    assert [call[0] for call in calls] == ["train", "bake", "picture", "turntable"]
    assert calls[0] == ("train", 14.4, True)  # 55 % of 30 minutes less the 228 s of what is made anew
    assert "train, 15:12 min left of 30:00 min" in capsys.readouterr().err
    assert summary()["steps"][0]["seconds"] == 960.0
    assert summary()["minutes"] == 30.0
    assert not Path("out/model.report.json").exists()
    assert kitchen.run("wax.toml", "-o", "out") == []
    with pytest.raises(PrtbakeError, match=r"out: was made for 30 minutes, found --minutes 20; omit it"):
        kitchen.run("wax.toml", "-o", "out", "--minutes", "20")


def test_the_quality_of_a_model_is_that_of_its_report(tmp_path):
    (tmp_path / "model.report.json").write_text('{"summary": ["the network is 9 % off"]}')
    assert steps._quality(str(tmp_path / "model.pt")) == "the network is 9 % off"


def test_minutes_that_are_over_already_are_refused(kitchen):
    kitchen.seconds["train"] = 900.0
    kitchen.run("wax.toml", "-o", "out", "--minutes", "16")
    with pytest.raises(PrtbakeError, match=r"out: has taken \d\d:\d\d min already, found --minutes 17; ask for more"):
        kitchen.run("wax.toml", "-o", "out", "--minutes", "17")


def test_other_pictures_are_made_alone(kitchen):
    kitchen.run("wax.toml", "-o", "out")
    calls = kitchen.run("wax.toml", "-o", "out", "--light", "sun:0,1,0", "--tone-map", "none", "--view", "back")
    assert [call[0] for call in calls] == ["picture", "turntable"]
    assert calls[0][2:] == ("sun:0,1,0", "none", 0.0, "back")
    calls = kitchen.run("wax.toml", "-o", "out", "--exposure", "-1")
    assert calls[0][-3:] == ("agx", -1.0, "")
    for irradiance, made in (("[1, 1, 1]", 2), ("[1, 1, 1]", 0), ("[2, 2, 2]", 2)):
        Path("lights.toml").write_text(f"[[directional]]\ndirection = [0, 1, 0]\nirradiance = {irradiance}\n")
        assert len(kitchen.run("wax.toml", "-o", "out", "--light", "lights.toml")) == made


def test_one_run_at_a_time(kitchen):
    Path("out").mkdir()
    with (
        only_run(Path("out")),
        pytest.raises(PrtbakeError, match="out: another `prtbake make` works in this folder; wait until it ends"),
    ):
        kitchen.run("wax.toml", "-o", "out")
    assert len(kitchen.run("wax.toml", "-o", "out")) == 4
    assert not Path("out/make.lock").exists()


def test_a_bake_that_is_too_slow_is_coarse(kitchen, capsys):
    kitchen.slow = True
    calls = kitchen.run("wax.toml", "-o", "out")
    assert calls[1:3] == [("bake", 0.02, 7.0, False), ("bake", 4, 0.0, False)]
    assert (
        "bake: not all vertices were ready after 7 minutes; a coarse bake follows, of fewer views"
        in capsys.readouterr().err
    )
    assert "--rings 4 --sectors 8 --samples 18" in summary()["steps"][1]["command"]


def test_the_exit_code_of_a_step_stops_the_rest(kitchen, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(kitchen, "finish", interrupted)
    with pytest.raises(SystemExit) as stopped:
        kitchen.app(args=["make", "wax.toml", "-o", "out"])
    assert stopped.value.code == 130
    assert summary()["steps"] == []


def test_a_step_that_ends_well_after_ctrl_c_is_not_finished(kitchen, monkeypatch):
    monkeypatch.setattr(signals, "_received", [])
    monkeypatch.setattr(kitchen, "finish", lambda *_: signals.record(2))
    with pytest.raises(SystemExit) as stopped:
        kitchen.app(args=["make", "wax.toml", "-o", "out"])
    assert stopped.value.code == 130
    assert summary()["steps"] == []


def test_what_the_time_is_over_for_is_left_out(kitchen, capsys):
    kitchen.seconds |= {"train": 1150.0, "bake": 130.0}
    kitchen.frame = 32.0  # 12 of them take longer than the tenth of the time that a later run has at least
    calls = kitchen.run("wax.toml", "-o", "out")
    assert calls[1][2] == 2.0  # the bake has a tenth of the time, however long the training took
    assert [call[0] for call in calls] == ["train", "bake", "picture"]
    assert "turntable: left out, since the time is over; to do it by hand: prtbake shade" in capsys.readouterr().err
    assert [step["name"] for step in summary()["steps"] if step["note"]] == ["turntable", "compress"]
    assert "| compress | 0 s | left out, since the time was over |" in Path("out/summary.md").read_text()
    assert not Path("out/compact.h5").exists()
    kitchen.seconds["turntable"] = 100.0
    assert kitchen.run("wax.toml", "-o", "out") == []
    kitchen.frame = 4.0
    Path("out/picture.png").unlink()
    assert [call[0] for call in kitchen.run("wax.toml", "-o", "out")] == ["picture", "turntable"]
    assert Path("out/compact.h5").exists()


def test_another_scene_or_foreign_files_are_refused(kitchen):
    kitchen.run("wax.toml", "-o", "out")
    text = Path("wax.toml").read_text()
    Path("wax.toml").write_text(text.replace("density = 1.0", "density = 2.0"))
    with pytest.raises(PrtbakeError, match=r"out: was made with scene_hash .* choose another folder, or add --force"):
        kitchen.run("wax.toml", "-o", "out")
    Path("wax.toml").write_text(text)
    kitchen.seconds |= {"train": 150.0, "bake": 40.0}
    assert len(kitchen.run("wax.toml", "-o", "out", "--minutes", "5", "--force")) == 4
    Path("out/summary.json").write_text("{}")
    with pytest.raises(PrtbakeError, match=r"summary\.json: was not written by `prtbake make`, or is damaged"):
        kitchen.run("wax.toml", "-o", "out")
    Path("out/summary.json").unlink()
    with pytest.raises(PrtbakeError, match=r"model\.pt: already exists; choose another folder, or add --force"):
        kitchen.run("wax.toml", "-o", "out")


def test_a_mesh_gets_a_scene_in_the_folder(kitchen, capsys):
    kitchen.run("ball.obj", "-o", "out", "--material", "jade", "--size", "4cm")
    assert 'material = "jade"' in Path("out/ball.toml").read_text()
    assert kitchen.run("ball.obj", "-o", "out", "--material", "jade", "--size", "4cm") == []
    assert "out/ball.toml: is there already, and is used; --force writes it anew" in capsys.readouterr().err
    assert kitchen.run("ball.obj", "-o", "out") == []
    with pytest.raises(PrtbakeError, match=r"ball\.toml: is another scene than --material and --size ask for"):
        kitchen.run("ball.obj", "-o", "out", "--material", "jade", "--size", "5cm")


def test_what_would_fail_later_is_refused_at_once(kitchen):
    with pytest.raises(typer.BadParameter, match="--material and --size are for meshes"):
        kitchen.run("wax.toml", "-o", "out", "--material", "jade")
    with pytest.raises(PrtbakeError, match=r"asset\.h5: expected a scene or a mesh \(SCENE\), found an asset"):
        kitchen.run(kitchen.asset, "-o", "out")
    with pytest.raises(PrtbakeError, match=r"missing\.hdr: there is no such file"):
        kitchen.run("wax.toml", "-o", "out", "--light", "missing.hdr")
    write_mesh(flipped(read_mesh("ball.obj")), "ball.obj")
    with pytest.raises(PrtbakeError, match=r"ball\.obj: the faces are wound inside out; flip the normals"):
        kitchen.run("wax.toml", "-o", "out")
    for size, words in (("", "--material and --size are"), ("0.1", "training, bake and pictures take 2 minutes")):
        with pytest.raises(typer.BadParameter, match=words):
            kitchen.run("wax.toml", "-o", "out", *(["--minutes", size] if size else ["--size", "3cm"]))
    assert kitchen.calls == []


def test_a_mesh_is_checked_before_anything_is_written(kitchen):
    trimesh.load("ball.obj").export("ball.glb")  # 2 m
    with pytest.raises(typer.BadParameter, match="Missing option '--material'"):
        kitchen.run("ball.glb", "-o", "new")
    with pytest.raises(PrtbakeError, match=r"missing\.hdr: there is no such file"):
        kitchen.run("ball.glb", "-o", "new", "--material", "jade", "--size", "5cm", "--light", "missing.hdr")
    with pytest.raises(typer.BadParameter, match="would look like stone; give its size") as error:
        kitchen.run("ball.glb", "-o", "new", "--material", "jade")
    assert not Path("new").exists()
    assert "such as: prtbake make ball.glb -o new --material jade --size 6cm (--size 2000mm keeps it)" in str(
        error.value
    )
    assert len(kitchen.run("ball.glb", "-o", "new", "--material", "jade", "--size", "2000mm")) == 4


@pytest.mark.statistics
@pytest.mark.usefixtures("compiled_kernels")
def test_a_mesh_becomes_an_asset_and_pictures(tmp_path, monkeypatch, capsys):
    """The real commands, on a ball of 42 vertices."""
    monkeypatch.chdir(tmp_path)
    ball = trimesh.creation.icosphere(subdivisions=1)
    write_mesh(build_mesh(ball.vertices, ball.faces), tmp_path / "ball.obj")
    command = ["make", "ball.obj", "-o", "out", "--material", "jade", "--size", "5cm", "--minutes", "2"]
    assert prtbake(command) == 0
    assert {"model.pt", "asset.h5", "picture.png", "summary.md"} <= {path.name for path in Path("out").iterdir()}
    assert summary()["figures"]["errors"]["total"][0] < 0.5
    assert [step["name"] for step in summary()["steps"]] == ["train", "bake", "picture", "turntable", "compress"]
    capsys.readouterr()
    assert prtbake(command) == 0
    assert "train: done already" in capsys.readouterr().err
