"""The table of baselines from synthetic figures."""

import json
import math
import re
from dataclasses import replace

import pytest

from formats.json_report import as_text
from prt_bake.mathematics.noise_free import Interval
from prt_bake.paper.baselines.contenders import CONTENDERS, EQUAL, FIGURES, Comparison, Entry
from prt_bake.paper.baselines.table import markdown, standing

SETTINGS = {"size": 512, "spp": 256, "train_minutes": 10.0, "quick": False}
NEUMIP = next(contender for contender in CONTENDERS if contender.name == "neumip")


def entry(name: str, error: float) -> Entry:
    figures = {figure: Interval(error, 0.9 * error, 1.1 * error) for figure in (*FIGURES, "relative_rmse")}
    training = {"walks": 12345, "relative_rmse": {"transport": None, "coefficients": 0.125}}
    return Entry(name, figures, dict.fromkeys(FIGURES, error), 3.25, 0.68, training)


def comparison(scene: str = "grape", sky: str = "outdoor") -> Comparison:
    errors = {contender.name: 0.02 * (1 + i) for i, contender in enumerate(CONTENDERS)} | {EQUAL: 0.01}
    share = {"value": 0.96, "low": 0.95, "high": 0.97}
    return Comparison(
        **{"scene": scene, "sky": sky, "source": f"{scene}.toml", "stand_in": scene != "grape", "pixels": 1234},
        **{"stops": 1.5, "reference": {"spp": 1024, "walks": 5000, "seconds": 77.0}},
        noise=dict.fromkeys(FIGURES, 0.001),
        ceiling={"transport": None, "coefficients": share, "behind": None},
        entries=tuple(entry(name, error) for name, error in errors.items()),
    )


def cells(page: str, title: str) -> list[str]:
    line = next(line for line in page.splitlines() if line.startswith(f"| {title} |"))
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_a_row_has_the_figures_with_intervals_and_the_papers_beside_them() -> None:
    page = markdown([comparison()], SETTINGS)
    row = cells(page, "NeuMIP")
    assert row[1:5] == ["0.12 (0.11–0.13)", *["0.120 (0.108–0.132)"] * 3]
    assert row[5:11] == ["12", "12", "–", "12.5%", "0.68", "3.25"]
    assert row[11:] == ["1.8e-04", "0.982", "0.990", "0.051", "2", "2.9"]
    assert cells(page, "*Best Lambert albedo*")[7:9] == ["–", "96%"]
    assert cells(page, "*noise*")[1] == "0.001"


def test_unknown_figures_are_dashes() -> None:
    unknown = {figure: Interval(math.nan, math.nan, math.nan) for figure in (*FIGURES, "relative_rmse")}
    whole = comparison()
    entries = tuple(replace(e, figures=unknown, training={}) if e.contender == "neumip" else e for e in whole.entries)
    page = markdown([replace(whole, entries=entries, noise=dict.fromkeys(FIGURES, None))], SETTINGS)
    assert cells(page, "NeuMIP")[1:9] == ["–"] * 8
    assert cells(page, "*noise*")[1:5] == ["–"] * 4
    assert "A dash is a figure that is unknown" in page
    assert not re.search(r"\bnan\b", page)
    assert standing(replace(whole, entries=entries), NEUMIP) == ""


def test_all_rows_of_a_table_have_as_many_cells() -> None:
    for scene in ("grape", "lucy"):
        page = markdown([comparison(scene)], SETTINGS)
        assert len({line.count("|") for line in page.splitlines() if line.startswith("|")}) == 1
        assert ("paper: MSE" in page) == (scene == "grape")


def test_the_papers_factors_are_those_of_its_table() -> None:
    found = {
        (scene, sky): comparison(scene, sky).published_factor(NEUMIP, "mse")
        for scene in ("grape", "paperweight")
        for sky in ("outdoor", "indoor")
    }
    assert min(found.values()) == pytest.approx(1.07, abs=0.01)
    assert max(found.values()) == pytest.approx(3.15, abs=0.01)
    assert comparison("grape", "another").published_factor(NEUMIP, "mse") is None


def test_a_missing_row_says_why() -> None:
    whole = comparison()
    entries = tuple(
        Entry(e.contender, missing="it has no values") if e.contender == "neumip" else e for e in whole.entries
    )
    page = markdown([replace(whole, entries=entries)], SETTINGS)
    assert "- NeuMIP is left out: it has no values" in page
    assert "| NeuMIP |" not in page
    assert standing(replace(whole, entries=entries), NEUMIP) == ""


def test_a_sentence_says_how_far_the_network_is_ahead() -> None:
    assert standing(comparison(), NEUMIP) == (
        "NeuMIP: its MSE is 12 times (paper 2) and its FLIP is 12 times (paper 2.9) that of Net after the same minutes"
    )
    assert not any(standing(comparison(), contender) for contender in CONTENDERS if contender.name == EQUAL)
    exact = replace(comparison(), entries=tuple(entry(c.name, 0.0) for c in CONTENDERS))
    assert standing(exact, NEUMIP) == ""


def test_the_figures_are_plain_json() -> None:
    read = json.loads(as_text(comparison().as_json()))
    assert read["paper"]["nerfactor"]["flip"] == 0.132
    assert read["entries"][3]["figures"]["mse"] == pytest.approx({"value": 0.08, "low": 0.072, "high": 0.088})
    assert Interval.from_json(read["entries"][3]["figures"]["mse"]) == comparison().entries[3].figures["mse"]
    unknown = Interval.from_json(json.loads(as_text(Interval(0.5, math.nan, math.nan).as_json())))
    assert (unknown.value, math.isnan(unknown.low), math.isnan(unknown.high)) == (0.5, True, True)
    assert read["entries"][3]["contender"] == "nerfactor-own-sky"
