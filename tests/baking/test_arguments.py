"""Invalid arguments of a bake raise before any work, and existing files stay unchanged."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from formats.atomic import remove_parts
from formats.errors import PrtbakeError, QueryError, StorageError
from formats.journal import Journal, journal_folder
from formats.mesh import Mesh
from prt_bake.baking import bake
from tests.bakers.transports import Incoherent, icosphere

SMALL = {"rings": 2, "sectors": 4, "samples": 18}


class NeverEvaluated:
    """A transport that must not be evaluated."""

    def evaluate(self, incident: Any, positions: Any, outgoing: Any) -> Any:
        raise AssertionError("evaluated")


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"seed": -1}, "seed must be at least 0, found -1"),
        ({"seed": 2**63}, "seed must be at most"),
        ({"seed": 1.5}, "seed must be a whole number, found 1.5"),
        ({"workers": 0}, "workers must be at least 1"),
        ({"workers": 5000}, "workers must be at most 1,024"),
        ({"degree": -1}, "degree must be at least 0"),
        ({"degree": 21}, "degree must be at most 20"),
        ({"rings": 0}, "rings must be at least 1"),
        ({"rings": 2.5}, "rings must be a whole number"),
        ({"rings": 300, "sectors": 300}, "at most 65,536 view bins, found 300 × 300"),
        ({"samples": 0}, "samples must be at least 1"),
        ({"samples": "64"}, "samples must be a whole number, found '64'"),
        ({"error": 0.0}, "error must be a relative RMSE between 0 and 1, found 0.0"),
        ({"error": math.nan}, "error must be a relative RMSE between 0 and 1, found nan"),
        ({"error": "small"}, "error must be a number, found 'small'"),
        ({"directions": "halton"}, "directions must be one of fibonacci, sobol, uniform, found 'halton'"),
        ({"precision": "float16"}, "precision must be one of float32, bfloat16"),
        ({"storage": "int8"}, "storage must be one of float16, float32"),
        ({"device": "tpu"}, "float32 on the cpu"),
        ({"leave_out": "views"}, r"leave_out must be a collection of names, such as \['views'\]"),
        ({"leave_out": ["vertices"]}, "leave_out: expected items of unseen, .*, found vertices"),
        ({"for_eye": (1, 2)}, "three finite numbers"),
    ],
)
@pytest.mark.parametrize("command", [bake.bake, bake.plan])
def test_invalid_arguments_raise_before_any_work(command: Any, arguments: dict[str, Any], sentence: str) -> None:
    with pytest.raises(QueryError, match=sentence):
        command(NeverEvaluated(), icosphere(0), **{**SMALL, **arguments})


@pytest.mark.parametrize("minutes", [0.0, -1.0, math.nan])
def test_minutes_must_be_positive(minutes: float) -> None:
    with pytest.raises(QueryError, match="minutes must be positive"):
        bake.bake(NeverEvaluated(), icosphere(0), **SMALL, minutes=minutes)


def test_a_mesh_without_vertices_raises() -> None:
    empty = Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros((0, 3)))
    for command in (bake.bake, bake.plan):
        with pytest.raises(QueryError, match="mesh: expected at least one vertex"):
            command(NeverEvaluated(), empty)  # type: ignore[operator]


@pytest.mark.parametrize("output", ["missing/a.h5", "folder.h5"])
def test_an_output_that_cannot_be_written_raises_before_any_work(tmp_path: Path, output: str) -> None:
    (tmp_path / "folder.h5").mkdir()
    with pytest.raises(StorageError, match="cannot be written"):
        bake.bake(NeverEvaluated(), icosphere(0), **SMALL, out=tmp_path / output)
    assert [path.name for path in tmp_path.iterdir()] == ["folder.h5"]


@pytest.mark.parametrize("resume", [False, True])
def test_foreign_files_at_the_place_of_the_journal_stay(tmp_path: Path, resume: bool) -> None:
    for output, own in (("a.h5", "a.h5.journal"), ("b.h5", "b.h5.journal/notes.txt")):
        foreign = tmp_path / own
        foreign.parent.mkdir(exist_ok=True)
        foreign.write_text("mine")
        with pytest.raises(
            StorageError, match=f"{output}.journal: expected a free path for the checkpoints of {output}"
        ):
            bake.bake(Incoherent(), icosphere(0), **SMALL, out=tmp_path / output, resume=resume)
        assert foreign.read_text() == "mine"


def test_two_bakes_of_one_output_do_not_mix(tmp_path: Path) -> None:
    out = tmp_path / "a.h5"
    with Journal(out, {"seed": 1}, resume=False) as journal:
        journal.write("block-0", {"one": np.ones(1)})
        for resume in (False, True):
            with pytest.raises(StorageError, match="another process is writing it"):
                bake.bake(Incoherent(), icosphere(0), **SMALL, out=out, resume=resume)
        assert journal.read("block-0") is not None
    assert sorted(path.name for path in journal_folder(out).iterdir()) == ["block-0.npz", "identity.json"]
    assert bake.bake(Incoherent(), icosphere(0), **SMALL, out=out).complete
    assert not journal_folder(out).exists()


def test_a_journal_of_an_older_version_is_not_resumed(tmp_path: Path) -> None:
    out = tmp_path / "a.h5"
    with Journal(out, {"seed": 0}, resume=False) as journal:
        journal.write("block-0-12", {"bent": np.zeros(1)})
    with pytest.raises(StorageError, match=r"journal_version was None and is 4; .* start again without resuming"):
        bake.bake(Incoherent(), icosphere(0), **SMALL, out=out, resume=True)
    assert bake.bake(Incoherent(), icosphere(0), **SMALL, out=out).complete


@pytest.mark.parametrize("directions", ["uniform", "sobol", "fibonacci"])
def test_an_error_out_of_reach_leaves_no_files(tmp_path: Path, directions: str) -> None:
    with pytest.raises(PrtbakeError, match=r"out of reach; .* request a larger error"):
        bake.bake(Incoherent(), icosphere(0), 2, 2, 4, directions, 64, 1e-9, out=tmp_path / "a.h5")
    assert not list(tmp_path.iterdir())


def test_the_first_pilot_detects_errors_out_of_reach_of_monte_carlo() -> None:
    evaluated = []

    class Counted(Incoherent):
        def evaluate(self, incident: Any, positions: Any, outgoing: Any) -> Any:
            evaluated.append(incident.shape[0] * incident.shape[1])
            return super().evaluate(incident, positions, outgoing)

    with pytest.raises(QueryError, match="64 directions a bin leave"):
        bake.bake(Counted(), icosphere(0), 2, 2, 4, "uniform", 64, 1e-4)
    assert sum(evaluated) == 12 * 8 * 64


def test_a_plan_to_an_error_predicts_the_directions_of_the_bake() -> None:
    arguments = Incoherent(), icosphere(0), 2, 2, 4, "sobol", 64
    plan = bake.plan(*arguments, error=0.02)
    assert plan.samples == bake.bake(*arguments, 0.02).provenance["settings"]["samples"] > 64


def test_temporary_files_of_killed_processes_are_removed_for_that_output_only(tmp_path: Path) -> None:
    for name in (".a.h5.0123abcd.part", ".my-a.h5.0123abcd.part", ".a.h5.part"):
        (tmp_path / name).touch()
    remove_parts(tmp_path, "a.h5")
    assert sorted(path.name for path in tmp_path.iterdir()) == [".a.h5.part", ".my-a.h5.0123abcd.part"]
