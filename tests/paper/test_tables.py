"""The tables of synthetic figures in Markdown, in JSON and on the sheet."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from formats.image.png import to_srgb
from prt_bake.paper import results as records
from prt_bake.paper import times
from prt_bake.paper.layers import network_settings, relative, variants
from prt_bake.paper.plots import plot_layers, plot_times, plot_training
from prt_bake.paper.results import METHODS, PAPER_MEANS, Line, Result
from prt_bake.paper.scenes import NAMES, SCENES
from prt_bake.paper.sheet import CELL, Row, Tile, write_sheet
from prt_bake.paper.sigma import SigmaPicture, write_sigma
from prt_bake.paper.tables import first_table, markdown, means_table, second_table
from prt_bake.paper.times import Trained, power_law, summary
from prt_bake.paper.times import as_json as times_json

SETTINGS = {"size": 512, "cores": 2, "quick": False}


def figures(flip: float) -> dict[str, float]:
    return {
        "mse": 1.2e-4,
        "ssim": 0.95,
        "ssim_quarter": 0.99,
        "flip": flip,
        "flip_without_noise": 0.9 * flip,
        "error": 0.05,
    }


def result(scene: str, sky: str = "outdoor", flip: float = 0.02, **changes: object) -> Result:
    lines = tuple(
        Line(method, 256, 12.5, 0.66, figures(3 * flip if method == "sh" else flip), figures(flip / 2))
        for method in METHODS
    )
    record = Result(
        **{"scene": scene, "sky": sky, "source": f"{scene}.toml", "stand_in": False},
        **{"framing": {"object_share": 0.45, "object_pixels": 1234}, "stops": 1.5},
        **{"reference": {"spp": 1024, "walks": 5000, "seconds": 77.0}, "noise": figures(0.011), "lines": lines},
    )
    return replace(record, **changes)


def cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_the_papers_figures_and_their_means() -> None:
    assert NAMES == ("grape", "dragon", "paperweight", "drink", "lucy")
    assert round(PAPER_MEANS["net"], 3) == 0.043
    assert round(PAPER_MEANS["sh"], 3) == 0.139
    assert sum(scene.path_tracing.seconds for scene in SCENES) == pytest.approx(9457.43)


def test_the_first_table_has_the_papers_columns() -> None:
    head, _rule, path, light, _lobe, _mis, harmonics = first_table([result("grape", stand_in=True)]).splitlines()
    assert cells(head)[:8] == ["Scene", "Model", "SPP", "s", "MB", "MSE", "SSIM", "FLIP"]
    noise = ["noise 1.2e-04", "noise 0.9500", "noise 0.0110"]
    assert cells(path)[:8] == ["Grape (stand-in)", "Path tracing", "1024", "77", "", *noise]
    assert cells(path)[13:] == ["10000", "1846", "", "", "", ""]
    assert cells(light)[1:] == [
        *[
            "Net (light)",
            "256",
            "12.5",
            "0.66",
            "1.2e-04",
            "0.9500",
            "0.0200",
            "0.0180",
            "5.0%",
            "1.2e-04",
            "0.9500",
            "0.0100",
        ],
        *["256", "2.04", "1.31", "1.6e-04", "0.975", "0.051"],
    ]
    assert cells(harmonics)[1:8] == ["SH", "256", "12.5", "0.66", "1.2e-04", "0.9500", "0.0600"]
    assert cells(harmonics)[13:] == ["1", "3.2e-04", "21.1", "2.8e-03", "0.983", "0.082"]
    assert len({len(cells(line)) for line in (head, path, light, harmonics)}) == 1


def test_the_difference_of_sh_and_net_is_reported() -> None:
    bare = result("lucy")
    lines = tuple(
        replace(line, alone={**line.alone, "flip_to_net": 0.0707}) if line.method == "sh" else line
        for line in bare.lines
    )
    text = "; FLIP of SH against Net (mis) 0.0707"
    assert text in markdown([replace(bare, lines=lines)], SETTINGS)
    assert text[:30] not in markdown([bare], SETTINGS)


def test_figures_of_complete_pictures_are_optional() -> None:
    bare = result("lucy")
    bare = replace(bare, lines=tuple(replace(line, whole=None) for line in bare.lines))
    assert cells(first_table([bare]).splitlines()[3])[10:13] == ["", "", ""]


def test_unknown_figures_are_dashes() -> None:
    nothing = dict.fromkeys(figures(0.0), None)
    bare = result("grape", noise=nothing)
    bare = replace(bare, lines=tuple(replace(line, alone=nothing, whole=nothing) for line in bare.lines))
    path, light = (cells(line) for line in first_table([bare]).splitlines()[2:4])
    assert path[5:8] == ["noise –"] * 3
    assert light[5:13] == ["–"] * 8
    assert [cells(line)[2:4] for line in second_table([bare]).splitlines()[2:]] == [["–", "–"]] * 4
    (mean,) = (cells(line) for line in means_table([bare], ["outdoor"]).splitlines() if "Net (mis)" in line)
    assert mean[3:9] == ["–", "≤ 0.03", "", "–", "–", "–"]
    page = markdown([bare, result("lucy")], SETTINGS)
    assert not re.search(r"\bnan\b", page)
    assert "A dash is a figure that is unknown" in page
    rows = [Trained(minutes, 1000, math.nan, 0.2, 0.2, math.nan) for minutes in (1.0, 2.0)]
    assert "a_lm –, picture –, FLIP 0.2000" in summary("dragon, outdoor", rows)


def test_the_second_table_has_the_scenes_and_skies_of_the_paper() -> None:
    rows = second_table([result("grape"), result("lucy"), result("paperweight", "indoor", 0.04)]).splitlines()[2:]
    assert [cells(line)[0] for line in rows] == ["Grape (outdoor)", "", "", "", "Paperweight (indoor)", "", "", ""]
    assert cells(rows[3]) == ["", "FLIP", "0.0200", "0.0110", "0.0174"]
    assert cells(rows[6]) == ["", "SSIM, quarter size", "0.9900", "0.9900", "0.9710"]


def test_a_target_is_evaluated_only_over_all_five_scenes() -> None:
    five = [result(name, flip=0.02 + 0.005 * i) for i, name in enumerate(NAMES)]
    rows = {cells(line)[1]: cells(line) for line in means_table(five, ["outdoor"]).splitlines()[2:]}
    assert rows["Net (mis)"] == [
        "outdoor",
        "Net (mis)",
        "5 of 5",
        "0.0300",
        "≤ 0.03",
        "yes",
        "0.0270",
        "5.0%",
        "0.0150",
        "0.043",
    ]
    assert rows["SH"] == ["outdoor", "SH", "5 of 5", "0.0900", "≤ 0.08", "no", "0.0810", "5.0%", "0.0150", "0.139"]
    assert rows["Net (light)"][4:6] == ["", ""]
    some = {cells(line)[1]: cells(line) for line in means_table(five[:4], ["outdoor"]).splitlines()[2:]}
    assert some["Net (mis)"][2:6] == ["4 of 5", "0.0275", "≤ 0.03", ""]


def test_the_page_names_missing_columns_and_small_objects() -> None:
    small = result("grape", framing={"object_share": 0.3, "object_pixels": 5})
    page = markdown([small, result("grape", "indoor")], {**SETTINGS, "quick": True})
    for text in (
        "NeRFactor and NeuMIP",
        "report paper --baselines",
        "less than 40%",
        "--quick",
        "1234 pixels",
        "1,234 pixels",
    ):
        assert (text in page) == (text != "1234 pixels")
    assert "--quick" not in markdown([small], SETTINGS)
    assert page.index("outdoor sky") < page.index("indoor sky")


def test_json_holds_all_results_and_reads_back() -> None:
    results = [result("grape"), result("drink", "indoor", 0.05)]
    values = json.loads(json.dumps(records.as_json(results, SETTINGS)))
    assert [Result.from_json(entry) for entry in values["results"]] == results
    assert values["mean_flip"]["indoor"]["sh"] == {
        **{"flip": pytest.approx(0.15), "flip_without_noise": pytest.approx(0.135)},
        **{"flip_everything_in": 0.025, "scenes": 1},
    }
    assert values["results"][1]["paper"]["net"]["flip"] == 0.043
    assert values["bars"] == {"net": 0.03, "sh": 0.08}
    assert math.isnan(records.mean_flip(results, "nowhere", "sh")[0])


def test_the_sheet_shows_pictures_above_their_flip_maps(tmp_path: Path) -> None:
    red, grey = np.zeros((2, 384, 384, 3))
    red[..., 0], grey[...] = 0.25, 0.05
    flip_map = np.zeros((384, 384))
    flip_map[:192] = 1.0
    rows = [Row("a, outdoor", 2.0, (Tile(red, None, ""), Tile(grey, flip_map, "FLIP 0.5"), None))] * 2
    write_sheet(tmp_path / "sheet.png", ("reference", "Net", "SH"), rows)
    pixels = np.asarray(Image.open(tmp_path / "sheet.png"))
    paper = pixels[-1, -1]
    block = (len(pixels) - 24) // 2
    for top in (24 + 18, 24 + 18 + block):
        middle = top + CELL // 2
        assert pixels[middle, 26 + CELL // 2].tolist() == [255, 0, 0]
        second = 26 + 6 + CELL + CELL // 2
        shown = round(255 * float(to_srgb(np.array(0.2))))
        assert pixels[middle, second].tolist() == [shown] * 3
        assert pixels[top + CELL + 20, second].tolist() == [252, 253, 191]  # magma at 1
        assert pixels[top + 2 * CELL - 20, second].tolist() == [0, 0, 4]  # magma at 0
        assert (pixels[middle, 26 + 2 * (CELL + 6) + CELL // 2] == paper).all()
        assert (pixels[top + CELL + 20, 26 + CELL // 2] == paper).all()


def test_the_networks_of_the_depth_ablation() -> None:
    assert network_settings(5, True).skips == ((1, 3), (2, 4))
    assert network_settings(7, True).skips == ((1, 3), (2, 4), (3, 5), (4, 6))
    assert network_settings(4, True).skips == network_settings(3, True).skips == ((1, 3),)
    assert set(variants()) == {"3", "3*", "4", "4*", "5", "5*", "6", "6*", "7", "7*"}
    assert all(settings.skips == () for name, settings in variants().items() if name.endswith("*"))
    assert relative({"5": 0.3, "7": 0.2}) == {"5": pytest.approx(1.5), "7": 1.0}
    assert math.isnan(relative({"5": 0.3, "7": 0.0})["5"])


def trained(minutes: float, flip: float) -> Trained:
    return Trained(minutes, round(1e6 * minutes), 0.1, 1.1 * flip, flip, 0.5 * flip)


def test_the_extrapolation_of_training_time() -> None:
    rows = [trained(minutes, 0.24 * minutes**-0.5) for minutes in (1.0, 4.0, 16.0)]
    law = power_law(rows, "flip_without_noise")
    assert (law.level, law.slope) == (pytest.approx(0.24), pytest.approx(-0.5))
    assert law.minutes_to(0.03) == pytest.approx(64.0)
    assert "would take 64 minutes" in summary("dragon, outdoor", rows)
    assert times_json(rows)["minutes_to_the_bar"] == pytest.approx(64.0)
    assert power_law(rows, "coefficients").minutes_to(0.03) == math.inf
    assert power_law([trained(1.0, 0.0)], "flip").minutes_to(0.03) == math.inf
    assert summary("dragon, outdoor", [trained(1.0, 0.2), trained(2.0, 0.2)]).endswith("cannot be extrapolated")


def test_trainings_of_unknown_error_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    model = SimpleNamespace(facts={"relative_rmse": {"coefficients": None}, "walks": 5})
    monkeypatch.setattr(times, "train_once", lambda *_: model)
    scene: Any = SimpleNamespace(
        paper=SimpleNamespace(name="grape"),
        artefacts=None,
        scene=None,
        settings=SimpleNamespace(device="cpu"),
        evaluate_model=lambda *_: {"flip": 0.2, "flip_without_noise": 0.1, "error": 0.3},
    )
    rows = times.trainings(scene, "outdoor", Path("sky.hdr"), 8.0, lambda *_: None)
    assert all(math.isnan(row.coefficients) for row in rows)
    assert power_law(rows, "flip_without_noise").level == pytest.approx(0.1)


def test_plots_are_written(tmp_path: Path) -> None:
    curve = [[float(t), 0.0, 1.0 / t] for t in range(1, 9)]
    plot_training({"grape": curve, "lucy": []}, tmp_path / "training.png")
    plot_layers({"dragon": {"5": 1.2, "5*": 2.0, "7": 1.0}}, tmp_path / "layers.png")
    plot_times({"dragon, outdoor": [trained(1.0, 0.2), trained(4.0, 0.1)]}, tmp_path / "times.png")
    degrees = np.full((8, 8), np.nan)
    degrees[2:6, 2:6] = 40.0
    write_sigma(tmp_path / "sigma.png", [SigmaPicture("Grape", degrees), SigmaPicture("Paperweight", degrees / 2)])
    for name in ("training", "layers", "times", "sigma"):
        assert np.ptp(np.asarray(Image.open(tmp_path / f"{name}.png").convert("L"))) > 100
