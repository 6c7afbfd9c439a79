"""`prtbake report bases` writes its table, numbers and plot, for models and for scenes."""

import json
from pathlib import Path

import pytest

from tests.cli.command_line import Run


@pytest.mark.parametrize(("source", "size"), [("model.pt", 8), ("model.pt", 0), ("scene.toml", 8)])
def test_the_report_has_a_row_for_every_basis(prtbake: Run, tmp_path: Path, source: str, size: int) -> None:
    pictures = source == "model.pt" and size > 0
    lights = ["--light", "sky.hdr", "--light", "sky.exr"] if pictures else ["--light", "sky.hdr"]
    outcome = prtbake(
        "report", "bases", source, "sphere.ply", *lights, "--out", tmp_path / "b", "--points", 8, "--size", size
    )
    assert outcome.code == 0, outcome.err
    reported = json.loads((tmp_path / "b" / "bases.json").read_text())
    names = [row["basis"] for row in reported["rows"]]
    assert {"SH degree 2", "learned", "Haar, the largest", "SH degree 2 and 1 Gaussian"} <= set(names)
    for row in reported["rows"]:
        assert (row["flip"] is not None) == pictures
        for figure in filter(None, [row["transport"], *row["radiance"].values()]):
            assert 0.0 <= figure["low"] <= figure["high"]
    page = (tmp_path / "b" / "bases.md").read_text(encoding="utf-8")
    assert all(f"| {name} |" in page for name in names)
    assert ("path traced" in page) == (source == "scene.toml")
    assert (tmp_path / "b" / "bases.png").stat().st_size > 1000


def test_two_lights_of_one_name_are_refused(prtbake: Run, tmp_path: Path) -> None:
    lights = ["--light", "sky.hdr", "--light", "sky.hdr"]
    outcome = prtbake("report", "bases", "model.pt", "sphere.ply", *lights, "--out", tmp_path / "b")
    assert outcome.code == 2
    assert "--light" in outcome.err
