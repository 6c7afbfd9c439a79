"""`prtbake report bake`: convergence of the methods, their reported errors, and the error budget of a picture."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from formats.errors import QueryError
from prt_bake.baking.report.bins import drawn_bins, fitted, relative
from prt_bake.baking.report.budget import error_budget, texels_of, visible_points
from prt_bake.baking.report.methods import Row, fixed_sample_rows, seconds_for, slope
from prt_bake.baking.report.page import as_markdown, rows_by_method
from prt_bake.baking.report.report import report_bake
from prt_bake.geometry import camera
from prt_bake.lights import environment
from tests.bakers.transports import Array, Edged, Lobed, icosphere
from tests.tracer.scenes import make_scene, sphere


class Linear:
    """Ŝ that is linear in ωi, for all positions and views."""

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
        return np.repeat((1.0 + 0.5 * incident[..., 2])[..., None], 3, axis=-1)


def sky() -> Array:
    image = np.random.default_rng(5).uniform(0.1, 1.0, size=(24, 48, 3)).astype(np.float32)
    image[4, 30] = 200.0
    return image


@pytest.mark.statistics
def test_errors_converge_at_the_rate_of_each_method() -> None:
    mesh = icosphere(1)
    bins = drawn_bins(mesh, 4, 64, 2, 4, 0)
    flat = np.repeat(mesh.positions[bins.vertices], 64, axis=0), bins.outgoing.reshape(-1, 3)
    reference = fitted(Edged(), *flat, 2, 4096, 1).reshape(4, 64, 9, 3)
    uniform, lattice = (fixed_sample_rows(Edged(), bins, kind, reference, 20.0, 3) for kind in ("uniform", "fibonacci"))
    logs = np.log([[row.evaluations, row.error] for row in uniform])
    assert np.polyfit(logs[:, 0], logs[:, 1], 1)[0] == pytest.approx(-0.5, abs=0.06)
    logs = np.log([[row.evaluations, row.error] for row in lattice[1:]])
    assert np.polyfit(logs[:, 0], logs[:, 1], 1)[0] < -0.65
    for row in uniform:
        assert 0.85 < row.reported / row.error < 1.15


def test_the_time_for_an_error_is_interpolated_and_extrapolated() -> None:
    rows = [Row("a", 2.0**k, 2.0**k, 0.4 * 2.0 ** (-0.5 * k), 0.0) for k in range(6)]
    assert slope(rows)[0] == pytest.approx(-0.5)
    assert seconds_for(rows, 0.1) == (pytest.approx(16.0), False)
    assert seconds_for(rows, 0.01) == (pytest.approx(1600.0), True)
    similar = [Row("a", 2.0**k, 1.0 + 0.01 * k, 0.4 * 2.0 ** (-0.5 * k), 0.0) for k in range(6)]
    assert np.isnan(slope(similar)[0])
    assert rows[0].efficiency == pytest.approx(1.0 / 0.16)
    table = as_markdown("Spot", [replace(row, method="uniform") for row in similar], [], 1024, [])
    assert "| uniform | unknown | unknown | unknown |" in table


def test_cells_hold_all_the_light_of_a_sky() -> None:
    image = np.ones((512, 1024, 3), np.float32)
    image[100, 200] = 1e5
    found = texels_of(image, "z").coefficients(2)
    # A cell of 2.8 degrees puts the light at its centre.
    np.testing.assert_allclose(found, environment.project(image, 2, "z"), atol=0.05 * np.abs(found).max())
    np.testing.assert_allclose(found[0], environment.project(image, 2, "z")[0], rtol=1e-6)


def test_visible_points_are_on_the_object_and_face_the_camera() -> None:
    mesh = icosphere(2)
    view = camera.fit(mesh, 64, 64, eye=np.array([4.0, 1.0, 2.0]), up="y")
    seen = visible_points(mesh, view, 100, 0)
    assert len(seen.positions) == 100
    # A ball of 320 triangles: normals differ slightly from positions.
    assert (seen.outgoing * seen.positions).sum(axis=1).min() > -0.1
    np.testing.assert_allclose(seen.shares.sum(axis=1), 1.0)
    away = camera.fit(mesh, 64, 64, eye=np.array([4.0, 1.0, 2.0]), up="y")
    away = type(away)(away.eye, away.eye + np.array([1.0, 0.0, 0.0]), away.up, 10.0, 64, 64)
    with pytest.raises(QueryError, match="sees nothing"):
        visible_points(mesh, away, 100, 0)


def test_parts_of_the_error_vanish_for_an_exact_bake() -> None:
    mesh = icosphere(1)
    view = camera.fit(mesh, 64, 64, up="y")
    arguments = {"degree": 2, "rings": 4, "sectors": 16, "up": "y", "points": 24, "seed": 0}
    none = {part.name: part.radiance for part in error_budget(Linear(), Linear(), mesh, sky(), view, **arguments)}
    assert none.pop("float16") < 1e-3
    assert max(none.values()) < 1e-6
    # A lobe about the view: harmonics and view bins err, and the total is about the largest part.
    some = {part.name: part.radiance for part in error_budget(Lobed(), Lobed(), mesh, sky(), view, **arguments)}
    assert some["harmonics of degree 2"] > 0.01
    assert some["between view bins"] > 1e-3
    assert some["between vertices"] > 1e-3
    most = max(value for name, value in some.items() if "together" not in name)
    assert 0.5 * most < some["all but the network together"] < 4.0 * most


@pytest.mark.statistics
def test_a_report_has_all_methods_and_the_error_budget(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, sphere(1), sigma_t=2.0, albedo=0.8)
    mesh = scene.mesh
    view = camera.fit(mesh, 64, 64, up="y")
    files = report_bake(
        Lobed(), mesh, tmp_path / "report", scene=scene, sky=sky(), view=view, rings=4, sectors=32, vertices=2,
        points=8, seconds=6.0,
    )  # fmt: skip
    assert [file.name for file in files] == ["bake.md", "bake.json", "bake.png"]
    found = json.loads(files[1].read_text())
    names = "method", "evaluations", "seconds", "error", "reported"
    methods = rows_by_method([Row(*(row[name] for name in names)) for row in found["rows"]])
    assert len(methods) == 5
    assert all(len(rows) >= 2 for rows in methods.values())
    logs = np.log([[row.evaluations, row.error] for row in methods["path traced"]])
    assert np.polyfit(logs[:, 0], logs[:, 1], 1)[0] == pytest.approx(-0.5, abs=0.35)
    assert {part["name"] for part in found["error_budget"]} >= {"the network", "between vertices", "float16"}
    text = files[0].read_text()
    assert "1 % takes" in text
    assert "efficiency" in text
    assert files[2].stat().st_size > 10_000


def test_the_relative_error_without_a_signal_is_0() -> None:
    assert relative(np.ones(3), np.zeros(3)) == 0.0
