"""The report's files: JSON for programs, and a self-contained page."""

import json
import re
import xml.etree.ElementTree as ElementTree
from html import escape
from html.parser import HTMLParser

import numpy as np
import pytest

from formats.errors import StorageError
from prt_bake.cli.main import main
from prt_bake.network.bssrdf import NetworkSettings, NeuralBSSRDF, save_model
from prt_bake.network.file_names import report_paths
from prt_bake.trainer import references
from prt_bake.trainer.report.assessment import assess
from prt_bake.trainer.report.page import training_page, write_training_report
from prt_bake.trainer.report.picture import SUNS, picture_summary, sun_text
from prt_bake.trainer.report.report import report_training
from prt_bake.trainer.report.summary import sentences, surface_error
from tests.tracer.scenes import make_scene, sphere
from tests.trainer.report.test_assessment import Network, NoisyTruth, truth

MOST_BYTES = 400 * 1024
EMPTY = {"meta", "link", "br", "hr", "img", "path", "use"}


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    scene = make_scene(tmp_path_factory.mktemp("ball"), sphere(2))
    network = Network(lambda *query: 1.05 * truth(*query))
    history = [[3.0, 500.0, None], *([6.0 * k, 1000.0 * k, 0.5 / np.sqrt(k)] for k in range(1, 20))]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(references, "MOST_BATCHES", 64)
        return assess(network, scene, queries=256, seconds=np.inf, tracer=NoisyTruth(1.0), history=history)


@pytest.fixture(scope="module")
def page(report):
    return training_page(report)


def test_the_files_are_beside_the_model(tmp_path):
    assert report_paths(tmp_path / "cow.pt") == (tmp_path / "cow.report.json", tmp_path / "cow.report.html")


@pytest.mark.statistics
def test_the_json_has_finite_numbers_and_determines_the_page(report, tmp_path):
    write_training_report(report, tmp_path / "a.json", tmp_path / "a.html")
    read = json.loads((tmp_path / "a.json").read_text(), parse_constant=pytest.fail)
    assert training_page(read) == (tmp_path / "a.html").read_text()
    assert read["history"]["of"] == "transport"
    assert read["transport"]["network"]["value"] == pytest.approx(0.05, rel=0.2)


def test_the_page_is_small_well_formed_and_self_contained(page):
    assert len(page.encode()) < MOST_BYTES
    without_namespaces = re.sub(r'xmlns(:\w+)?="[^"]*"|<!DOCTYPE[^>]*>', "", page)
    assert not re.search(r"""(src|href)\s*=\s*["'](?!data:|#)|url\((?!#)|https?://""", without_namespaces)
    open_tags = []

    class Balance(HTMLParser):
        def handle_starttag(self, tag, attributes):
            if tag not in EMPTY:
                open_tags.append(tag)

        def handle_endtag(self, tag):
            if tag not in EMPTY:
                assert open_tags.pop() == tag

    Balance().feed(page)
    assert open_tags == []


def test_every_plot_has_the_page_s_text_colour_and_unique_ids(page):
    plots = re.findall(r"<svg.*?</svg>", page, re.DOTALL)
    assert len(plots) == 6
    names = []
    for plot in plots:
        root = ElementTree.fromstring(plot)
        found = [element.get("id") for element in root.iter() if element.get("id")]
        used = re.findall(r"(?:url\(#|href=\"#)([^)\"]+)", plot)
        assert set(used) <= set(found)
        names += found
        assert "currentColor" in plot
        assert not re.search(r"#000000|#010203", plot)
    assert len(names) == len(set(names))


def test_the_page_shows_figures_with_their_intervals(report, page):
    network = report["transport"]["network"]
    assert f"{100 * network['value']:.2f} % ({100 * network['low']:.2f} to {100 * network['high']:.2f})" in page
    for row in report["criteria"]:
        assert escape(row["name"]) in page
    assert "prefers-color-scheme: dark" in page


def test_a_page_that_cannot_be_written_leaves_no_files(report, tmp_path):
    with pytest.raises(StorageError):
        write_training_report(report, tmp_path / "none" / "a.json", tmp_path / "a.html")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.statistics
def test_the_command_reports_on_a_model_and_refuses_another_scene(tmp_path, capfd):
    scene = make_scene(tmp_path, sphere(1))
    settings = NetworkSettings(features=8, width=8, layers=2, skips=(), directions="cartesian")
    network = NeuralBSSRDF(settings, [-1.0] * 3, 2.0, 0.05, {"scene_hash": scene.content_hash})
    save_model(network, tmp_path / "m.pt")
    words = ["report", "training", str(tmp_path / "m.pt"), str(scene.path)]
    assert main([*words, "--seconds", "0.1", "--queries", "16", "--vertices", "16"]) == 0
    assert "not met" in capfd.readouterr().out
    read = json.loads((tmp_path / "m.report.json").read_text())
    assert read["transport"]["network"]["value"] > 0.1
    assert (tmp_path / "m.report.html").stat().st_size < 2 * MOST_BYTES  # with two pictures
    assert [picture["sun"] for picture in read["pictures"]] == list(SUNS)
    page = (tmp_path / "m.report.html").read_text()
    for picture in read["pictures"]:
        assert picture_summary(picture) in read["summary"]
        assert sum(f"sun {sun_text(picture)}" in row["name"] for row in read["criteria"]) == 1
        assert f"{picture['flip']:.4f}" in page
        assert picture["webp"] in page
    network.metadata["scene_hash"] = "another"
    save_model(network, tmp_path / "m.pt")
    assert main(words) == 1
    assert "was trained on another scene" in capfd.readouterr().err


def test_a_report_without_time_has_no_pictures_and_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr("prt_bake.trainer.report.report.write_training_report", lambda *_: None)
    scene, shares = make_scene(tmp_path, sphere(1)), []
    network = Network(lambda *query: 1.05 * truth(*query))
    network.metadata = {}
    found, _page = report_training(network, scene, tmp_path / "m.pt", within=0.0, follow=shares.append)
    assert found["pictures"] == []
    assert "the time was too short" in found["summary"][-1]
    assert found["summary"][0].startswith("the network is ")
    assert found["reference"]["coefficients"]["queries"] == 8
    assert shares == sorted(shares)


def test_a_report_has_the_error_of_the_training_unless_its_own_has_more_queries(report):
    """A bound alone, the upper end of an interval from 0, is no error."""
    own, count = report["coefficients"]["surface"]["network"], report["coefficients"]["surface"]["of"]
    known, bound = [0.05, 0.07], [0.0, 0.061]
    for queries, interval, value in (
        (count, known, 0.061),
        (count - 1, known, own["value"]),
        (count, bound, own["value"]),
    ):
        final = {"coefficients": 0.061, "coefficients_interval": interval, "queries": queries}
        found = {**report, "model": {**report["model"], "final_errors": final}}
        text = sentences(found)
        assert text[0].startswith(f"the network is {100 * value:.1f} % off (")
        assert text[2].startswith(f"Relative RMSE of the coefficients over the surface: {value:.2%}")
        assert ("measured at the end of the training" in text[2]) == (value == 0.061)
        assert surface_error(found).value == value
    assert "at the end" not in "".join(report["summary"])
