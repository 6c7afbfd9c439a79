"""`prtbake make`: its steps, their times and its pictures."""

import re
from pathlib import Path

import pytest
import trimesh

from formats.errors import PrtbakeError
from formats.mesh import build_mesh, write_mesh
from prt_bake.cli.main import main as prtbake
from prt_bake.cli.making import steps
from prt_bake.cli.making.record import only_run
from prt_bake.shipped.examples import example
from tests.cli.making.stand_ins import SECONDS, summary


def test_the_steps_share_the_time(stand_ins, capsys):
    calls = stand_ins.run("wax.toml", "-o", "out", "--minutes", "20")
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
    assert "The same by hand; `sky.hdr` is the shipped sky, which `prtbake example DIR` copies:\n" in page
    assert "    prtbake shade out/asset.h5 --light sky.hdr --light sun:0.6,0.6,-0.6:2,1.9,1.7:3 " in page
    assert str(example("sky.hdr").parent) not in page + stand_ins.shown_command
    assert "--light sky.hdr" in stand_ins.shown_command
    captured = capsys.readouterr()
    assert captured.out.startswith("out/summary.md: error of the asset ")
    assert "out/asset.h5: " in captured.out
    assert "the same asset, to pass on: coefficients at most 0.5 % off" in captured.out
    assert "out/model.pt: the network is 9.0 % off" in captured.err
    assert "next: prtbake view out/asset.h5" in captured.err.splitlines()[-1]
    assert captured.err.count("next: ") == 1


def test_finished_steps_are_not_done_again(stand_ins, capsys):
    stand_ins.run("wax.toml", "-o", "out", "--light", "sun:0,1,0")
    assert stand_ins.run("wax.toml", "-o", "out", "--light", "sun:0,1,0") == []
    assert "train: done already, in 11:00 min" in capsys.readouterr().err
    Path("out/asset.h5").unlink()
    calls = stand_ins.run("wax.toml", "-o", "out", "--light", "sun:0,1,0")
    assert [call[0] for call in calls] == ["bake", "picture", "turntable"]
    assert calls[1] == ("picture", 0, "sun:0,1,0", "agx", 0.0, "")


def test_more_minutes_train_on(stand_ins, capsys):
    stand_ins.run("wax.toml", "-o", "out", "--minutes", "16")
    stand_ins.seconds["train"] = 300.0
    Path("out/model.report.json").write_text("the report of the shorter training")
    calls = stand_ins.run("wax.toml", "-o", "out", "--minutes", "30")
    assert [call[0] for call in calls] == ["train", "bake", "picture", "turntable"]
    assert calls[0] == ("train", 14.4, True)  # 55 % of 30 minutes less the 228 s of what is made again
    assert "train, 15:12 min left of 30:00 min" in capsys.readouterr().err
    assert summary()["steps"][0]["seconds"] == 960.0
    assert summary()["minutes"] == 30.0
    assert not Path("out/model.report.json").exists()
    assert stand_ins.run("wax.toml", "-o", "out") == []
    with pytest.raises(PrtbakeError, match=r"out: was made for 30 minutes, found --minutes 20; omit it"):
        stand_ins.run("wax.toml", "-o", "out", "--minutes", "20")


def test_few_more_minutes_keep_the_model_and_make_what_was_left_out(stand_ins, capsys):
    """A bake again, in less time than the first had, would be worse, and the training would not go on."""
    stand_ins.seconds["train"], stand_ins.frame = 1150.0, 32.0
    stand_ins.run("wax.toml", "-o", "out")
    stand_ins.frame = 4.0
    asset = Path("out/asset.h5").stat()
    assert [call[0] for call in stand_ins.run("wax.toml", "-o", "out", "--minutes", "26")] == ["turntable"]
    assert Path("out/asset.h5").stat() == asset
    found = capsys.readouterr().err
    assert "--minutes 26 is too short to train on and bake again, so its model and its asset stay" in found
    enough = re.search(r"ask for (\d+) or more to train on", found)[1]
    assert stand_ins.run("wax.toml", "-o", "out", "--minutes", str(int(enough) - 1)) == []
    again = re.search(r"ask for (\d+) or more to train on", capsys.readouterr().err)[1]
    first, *_ = stand_ins.run("wax.toml", "-o", "out", "--minutes", again)
    assert first[0] == "train"
    assert 60.0 * first[1] > 1.2 * 1150.0


def test_the_quality_of_a_model_is_that_of_its_report(tmp_path):
    (tmp_path / "model.report.json").write_text('{"summary": ["the network is 9 % off"]}')
    assert steps._quality(str(tmp_path / "model.pt")) == "the network is 9 % off"


def test_minutes_that_are_over_already_are_refused(stand_ins):
    stand_ins.seconds["train"] = 900.0
    stand_ins.run("wax.toml", "-o", "out", "--minutes", "16")
    with pytest.raises(PrtbakeError, match=r"out: has taken \d\d:\d\d min already, found --minutes 17; ask for more"):
        stand_ins.run("wax.toml", "-o", "out", "--minutes", "17")


def test_other_pictures_are_made_alone(stand_ins):
    stand_ins.run("wax.toml", "-o", "out")
    calls = stand_ins.run("wax.toml", "-o", "out", "--light", "sun:0,1,0", "--tone-map", "none", "--view", "back")
    assert [call[0] for call in calls] == ["picture", "turntable"]
    assert calls[0][2:] == ("sun:0,1,0", "none", 0.0, "back")
    calls = stand_ins.run("wax.toml", "-o", "out", "--exposure", "-1")
    assert calls[0][-3:] == ("agx", -1.0, "")
    for irradiance, made in (("[1, 1, 1]", 2), ("[1, 1, 1]", 0), ("[2, 2, 2]", 2)):
        Path("lights.toml").write_text(f"[[directional]]\ndirection = [0, 1, 0]\nirradiance = {irradiance}\n")
        assert len(stand_ins.run("wax.toml", "-o", "out", "--light", "lights.toml")) == made


def test_one_run_at_a_time(stand_ins):
    Path("out").mkdir()
    with (
        only_run(Path("out")),
        pytest.raises(PrtbakeError, match="out: another `prtbake make` works in this folder; wait until it ends"),
    ):
        stand_ins.run("wax.toml", "-o", "out")
    assert len(stand_ins.run("wax.toml", "-o", "out")) == 4
    assert not Path("out/make.lock").exists()


def test_a_bake_that_is_too_slow_is_coarse(stand_ins, capsys):
    stand_ins.slow = True
    calls = stand_ins.run("wax.toml", "-o", "out")
    assert calls[1:3] == [("bake", 0.02, 7.0, False), ("bake", 4, 0.0, False)]
    assert (
        "bake: not all vertices were ready after 7 minutes; a coarse bake follows, of fewer views"
        in capsys.readouterr().err
    )
    assert "--rings 4 --sectors 8 --samples 18" in summary()["steps"][1]["command"]


def test_a_bake_that_has_most_vertices_goes_on(stand_ins, monkeypatch, capsys):
    stand_ins.slow = True
    monkeypatch.setattr(steps, "_share_ready", lambda path: 0.75)
    calls = stand_ins.run("wax.toml", "-o", "out")
    assert calls[1:3] == [("bake", 0.02, 7.0, False), ("bake", 16, 4.83, True)]  # twice a third of 7 minutes, and 10 s
    assert "bake: 75% of the vertices were ready after 7 minutes; the others follow" in capsys.readouterr().err


def test_what_the_time_is_over_for_is_left_out(stand_ins, capsys):
    stand_ins.seconds |= {"train": 1150.0, "bake": 130.0}
    stand_ins.frame = 32.0  # 12 of them take longer than the tenth of the time that a later run has at least
    calls = stand_ins.run("wax.toml", "-o", "out")
    assert calls[1][2] == 2.0  # the bake has a tenth of the time, however long the training took
    assert [call[0] for call in calls] == ["train", "bake", "picture"]
    assert "turntable: left out, since the time is over; to do it by hand: prtbake shade" in capsys.readouterr().err
    assert [step["name"] for step in summary()["steps"] if step["note"]] == ["turntable", "compress"]
    assert "| compress | 0 s | left out, since the time was over |" in Path("out/summary.md").read_text()
    assert not Path("out/compact.h5").exists()
    stand_ins.seconds["turntable"] = 100.0
    assert stand_ins.run("wax.toml", "-o", "out") == []
    stand_ins.frame = 4.0
    Path("out/picture.png").unlink()
    assert [call[0] for call in stand_ins.run("wax.toml", "-o", "out")] == ["picture", "turntable"]
    assert Path("out/compact.h5").exists()


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
