"""`prtbake make` that was stopped: what it says, and what the same command continues."""

import json
from pathlib import Path

import pytest

from formats.errors import PrtbakeError
from prt_bake.cli.shared import signals
from tests.cli.making.stand_ins import summary


def test_a_stopped_training_is_resumed(stand_ins, capsys):
    stand_ins.broken = "train"
    with pytest.raises(PrtbakeError, match="train: stopped"):
        stand_ins.run("wax.toml", "-o", "out")
    again = "finished steps are kept, and this continues with train: prtbake make wax.toml -o out\n"
    assert f"train was not finished; {again}" in capsys.readouterr().err
    stand_ins.broken = ""
    assert stand_ins.run("wax.toml", "-o", "out")[0] == ("train", 11.0, True)


def test_a_stopped_bake_is_resumed_with_the_time_that_is_left(stand_ins, capsys):
    stand_ins.broken = "bake"
    with pytest.raises(PrtbakeError, match="bake: stopped"):
        stand_ins.run("wax.toml", "-o", "out")
    stand_ins.broken, stand_ins.seconds["bake"] = "", 100.0
    capsys.readouterr()
    calls = stand_ins.run("wax.toml", "-o", "out")
    assert [call[0] for call in calls] == ["bake", "picture", "turntable"]
    assert calls[0] == ("bake", 0.02, 3.67, True)  # 7 minutes less 200 s
    assert "bake, 5:40 min left of 20:00 min" in capsys.readouterr().err
    assert "--resume" not in Path("out/summary.md").read_text()
    assert summary()["steps"][1]["seconds"] == 300.0
    assert summary()["spent"] == 988.0


def test_time_that_is_lost_is_taken_from_all_steps(stand_ins):
    """A training that was stopped before it had a checkpoint begins again."""
    stand_ins.broken, stand_ins.part = "train", 1.0 / 3.0
    with pytest.raises(PrtbakeError, match="train: stopped"):
        stand_ins.run("wax.toml", "-o", "out")
    Path("out/model.train.pt").unlink()
    record = json.loads(Path("out/summary.json").read_text())
    Path("out/summary.json").write_text(json.dumps(record | {"unfinished": {}}))
    stand_ins.broken, stand_ins.part = "", 1.0
    assert stand_ins.run("wax.toml", "-o", "out")[0] == ("train", 8.98, False)  # 55 % of 20 minutes less 220 s


def test_the_exit_code_of_a_step_stops_the_rest(stand_ins, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(stand_ins, "finish", interrupted)
    with pytest.raises(SystemExit) as stopped:
        stand_ins.run("wax.toml", "-o", "out", standalone=True)
    assert stopped.value.code == 130
    assert summary()["steps"] == []


def test_a_step_that_ends_well_after_ctrl_c_is_not_finished(stand_ins, monkeypatch):
    monkeypatch.setattr(signals, "_received", [])
    monkeypatch.setattr(stand_ins, "finish", lambda *_: signals.record(2))
    with pytest.raises(SystemExit) as stopped:
        stand_ins.run("wax.toml", "-o", "out", standalone=True)
    assert stopped.value.code == 130
    assert summary()["steps"] == []


@pytest.fixture
def ctrl_c(stand_ins, monkeypatch):
    """A step that fails was stopped by Ctrl-C."""
    monkeypatch.setattr(signals, "_received", [])
    stand_ins.by_ctrl_c = True


@pytest.mark.usefixtures("ctrl_c")
def test_after_ctrl_c_the_same_command_without_force_continues(stand_ins, capsys):
    """The error of a step that has kept its work names --resume, which `make` does not have."""
    stand_ins.broken = "bake"
    with pytest.raises(SystemExit) as stopped:
        stand_ins.run("wax.toml", "-o", "out", "--light", "sun:0,1,0", "--force", standalone=True)
    assert stopped.value.code == 130
    again = "finished steps are kept, and this continues with bake: prtbake make wax.toml -o out --light sun:0,1,0\n"
    assert f"bake was not finished; {again}" in capsys.readouterr().err


@pytest.mark.usefixtures("ctrl_c")
def test_a_stop_after_the_time_of_a_bake_stops_the_rest(stand_ins):
    """A coarse bake would remove what the stopped one has kept."""
    stand_ins.slow = True
    with pytest.raises(SystemExit) as stopped:
        stand_ins.run("wax.toml", "-o", "out", standalone=True)
    assert stopped.value.code == 130
    assert [call[0] for call in stand_ins.calls] == ["train", "bake"]
    assert Path("out/asset.h5.journal").is_dir()
