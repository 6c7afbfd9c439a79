"""Suns in the preview: in the harmonics while something moves, then refined to the radiance of `prtbake shade`."""

import dataclasses
import math

import numpy as np
import pytest

import prt_bake as prt
from formats.asset import Asset
from formats.errors import QueryError
from formats.mesh import build_mesh
from prt_bake.lights import environment
from prt_bake.lights.lighting import as_lighting
from prt_bake.preview import legend, reasons, refinement
from prt_bake.preview import window as windows
from prt_bake.preview.lights import LightSource
from prt_bake.preview.refinement import facing, is_closed
from prt_bake.preview.state import Mode, Preview
from prt_bake.shading.picture import shade
from prt_bake.shading.sun_shading import suns_apart
from prt_bake.shading.vertices import shade_vertices
from tests.baking.lobes.transports import MESH, Lobed
from tests.preview.windows import bare_picture, drag, open_window, press, slide, write_sky
from tests.shading.test_picture import make_asset, painted_sky
from tests.shading.test_suns import lobed
from tests.shapes import ball, ring

EYE = np.array([0.3, 1.2, 3.5])


def sunny() -> np.ndarray:
    """Return a sky with pixels of 2.8°, one of them a sun."""
    sky = np.repeat(np.repeat(0.05 * painted_sky(), 4, axis=0), 4, axis=1)
    sky[20, 70] = [900.0, 700.0, 400.0]
    return sky


@pytest.fixture
def sky(tmp_path, monkeypatch) -> str:
    monkeypatch.chdir(tmp_path)
    return write_sky(tmp_path / "sunny.exr", sunny())


def made(sky: str, asset: Asset | None = None, **chosen) -> Preview:
    asset = lobed() if asset is None else asset
    return Preview(asset, [LightSource(sky, asset.up, asset.degree)], **chosen)


def shaded(preview: Preview, treatment: str = "split", eye=EYE) -> np.ndarray:
    """Return the radiance of `prtbake shade` at the vertices."""
    asset = preview.asset
    light = suns_apart(as_lighting(sunny(), asset.up, preview.rotation), asset.degree, treatment)
    return shade_vertices(asset, light.harmonics, eye, None, light.suns).radiance


@pytest.mark.parametrize("rotation", [0.0, 130.0])
@pytest.mark.parametrize("up", ["y", "z"])
def test_refined_colours_equal_shade(sky, up, rotation) -> None:
    preview = made(sky, dataclasses.replace(lobed(), up=up), rotation=rotation)
    split, plain = shaded(preview), shaded(preview, "plain")
    seen = facing(preview.asset.mesh, EYE) & preview.asset.valid
    assert 0.2 < seen.mean() < 0.8
    assert np.abs(split - plain)[seen].max() > 0.05
    np.testing.assert_allclose(preview.colours(EYE)[:, :3], plain, atol=1e-5)
    assert preview.refine(EYE)
    shown = preview.colours(EYE)[:, :3]
    np.testing.assert_allclose(shown[seen], split[seen], rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(shown[~seen], plain[~seen], atol=1e-5)


def test_an_asset_with_lobes_is_refined_in_the_dark() -> None:
    """Lobes are drawn everywhere once their kernels are loaded, and refined to what `shade` shows."""
    asset, sun = prt.bake(Lobed(), MESH, rings=4, sectors=16, lobes=4), "sun:0.3,1,0.2:2,2,2:0.5"
    preview = Preview(asset, [LightSource(sun, asset.up, asset.degree)], rotation=40.0)
    assert preview.suns_shown(EYE) == "plain"
    preview.load()
    assert preview.suns_shown(EYE) == "lobes"
    light = prt.light_for(asset, prt.read_lighting(sun).turned(40.0, "y"))
    seen, expected = facing(asset.mesh, EYE), prt.shade(asset, light, EYE)
    assert np.abs(preview.colours(EYE)[:, :3] - expected)[seen].max() > 1e-3
    assert preview.refine(EYE)
    np.testing.assert_allclose(preview.colours(EYE)[:, :3][seen], expected[seen], rtol=1e-6, atol=1e-7)
    assert preview.suns_shown(EYE) == "lobes"


def test_all_vertices_of_an_open_mesh_are_refined(sky) -> None:
    whole = lobed()
    open_mesh = build_mesh(whole.mesh.positions, whole.mesh.faces[3:])
    preview = made(sky, dataclasses.replace(whole, mesh=open_mesh))
    preview.refine(EYE)
    np.testing.assert_allclose(preview.colours(EYE)[:, :3], shaded(preview), rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("treatment", ["plain", "window"])
def test_other_treatments_need_no_refinement(sky, treatment) -> None:
    preview = made(sky, suns=treatment)
    expected = shaded(preview, treatment)
    np.testing.assert_allclose(preview.colours(EYE)[:, :3], expected, atol=1e-5)
    assert not preview.unrefined(EYE)
    assert not preview.refine(EYE)
    np.testing.assert_allclose(preview.colours(EYE)[:, :3], expected, atol=1e-5)
    assert preview.suns_shown(EYE) == treatment


def test_refinement_in_slices_equals_refinement_at_once(sky, monkeypatch) -> None:
    at_once, sliced = made(sky), made(sky)
    at_once.refine(EYE)
    monkeypatch.setattr(refinement, "_VERTICES_AT_ONCE", 8)
    before = sliced.colours(EYE).copy()
    slices = 0
    while not sliced.refine(EYE, 0.0):
        slices += 1
        np.testing.assert_array_equal(sliced.colours(EYE), before)  # unfinished refinement is not shown
    assert slices > 1
    np.testing.assert_array_equal(sliced.colours(EYE), at_once.colours(EYE))


def test_only_the_eye_and_the_light_reset_the_refinement(sky) -> None:
    preview = made(sky)
    preview.refine(EYE)
    refined = preview.colours(EYE).copy()
    preview.set_exposure(2.0)
    preview.toggle_background()
    assert preview.suns_shown(EYE) == "split"
    np.testing.assert_array_equal(preview.colours(EYE), refined)
    assert preview.suns_shown(-EYE) == "plain"
    np.testing.assert_allclose(preview.colours(-EYE)[:, :3], shaded(preview, "plain", -EYE), atol=1e-5)
    preview.rotate_to(20.0)
    np.testing.assert_allclose(preview.colours(EYE)[:, :3], shaded(preview, "plain"), atol=1e-5)
    preview.rotate_to(0.0)
    preview.refine(EYE)
    np.testing.assert_array_equal(preview.colours(EYE), refined)


def test_a_sky_without_a_sun_needs_no_refinement(tmp_path) -> None:
    preview = made(write_sky(tmp_path / "sky.exr", painted_sky()))
    assert not preview.unrefined(EYE)
    assert preview.suns_shown(EYE) is None
    assert "u" not in dict(legend.keys(preview, None))
    assert "no suns" in reasons.of_suns(preview)


def test_false_colours_and_eyes_inside_are_not_refined(sky) -> None:
    preview = made(sky)
    preview.show(Mode.ERROR)
    assert not preview.refine(EYE)
    preview.show(Mode.ERROR)
    assert not preview.refine(np.zeros(3))
    with pytest.raises(QueryError, match="inside"):
        preview.colours(np.zeros(3))


def test_an_asset_made_for_one_light_has_no_suns() -> None:
    asset = dataclasses.replace(make_asset(ball(2), degree=0, quantity="radiance"), degree=2)
    preview = Preview(asset, [])
    assert not preview.refine(EYE)
    assert preview.suns_shown(EYE) is None


def test_is_closed() -> None:
    closed = ball(2)
    assert is_closed(closed)
    assert is_closed(ring())
    inside_out = dataclasses.replace(closed, faces=closed.faces[:, ::-1])
    one_flipped = closed.faces.copy()
    one_flipped[5] = one_flipped[5, ::-1]
    for faces in (inside_out.faces, closed.faces[1:], np.concatenate([closed.faces, closed.faces[:1]]), one_flipped):
        assert not is_closed(dataclasses.replace(closed, faces=faces))


def test_the_vertices_of_a_ball_that_face_the_eye_are_its_visible_cap() -> None:
    mesh = ball(4)
    height = mesh.positions @ (EYE / np.linalg.norm(EYE))
    edge = 1.0 / np.linalg.norm(EYE)
    seen = facing(mesh, EYE)
    assert seen[height > edge].all()
    assert not seen[height < edge - 0.15].any()


@pytest.fixture
def opened(sky, monkeypatch):
    """A window with a sunny and a sunless sky."""
    window = open_window(lobed(), [sky, write_sky(windows.Path("sky.exr"), painted_sky())])
    yield window
    window.plotter.close()


def tick_until_refined(window) -> None:
    """Send timer events until the picture is refined."""
    interactor = window.plotter.iren.interactor
    for _ in range(100):
        interactor.InvokeEvent("TimerEvent")
        if not window.view.unrefined:
            return
    pytest.fail("the refinement does not finish")


def status(window) -> str:
    return window.overlay.status.GetInput()


def test_a_resting_window_shows_what_shade_shows(opened, monkeypatch) -> None:
    preview, eye = opened.view.preview, opened.view.eye
    plain = shaded(preview, "plain", eye)
    np.testing.assert_allclose(opened.view.colours[:, :3], plain, atol=1e-5)
    assert "suns in harmonics" in status(opened)
    monkeypatch.setattr(windows, "_STILL", 1e9)
    opened.plotter.iren.interactor.InvokeEvent("TimerEvent")
    assert "suns in harmonics" in status(opened)
    monkeypatch.setattr(windows, "_STILL", 0.0)
    tick_until_refined(opened)
    seen = facing(preview.asset.mesh, eye) & preview.asset.valid
    np.testing.assert_allclose(opened.view.colours[seen, :3], shaded(preview, "split", eye)[seen], rtol=1e-6, atol=1e-7)
    assert "suns split" in status(opened)


def test_a_moving_window_shows_suns_in_harmonics(opened, monkeypatch) -> None:
    monkeypatch.setattr(windows, "_STILL", 0.0)
    for move in (lambda: drag(opened, (60, 45), (80, 50)), lambda: slide(opened.rotation, 30.0)):
        tick_until_refined(opened)
        assert "suns split" in status(opened)
        move()
        preview, eye = opened.view.preview, opened.view.eye
        np.testing.assert_allclose(opened.view.colours[:, :3], shaded(preview, "plain", eye), atol=1e-5)
        assert "suns in harmonics" in status(opened)


def test_a_key_toggles_the_treatment_of_suns(opened, monkeypatch) -> None:
    monkeypatch.setattr(windows, "_STILL", 0.0)
    tick_until_refined(opened)
    refined = opened.view.colours.copy()
    press(opened, "u")
    preview, eye = opened.view.preview, opened.view.eye
    for _ in range(3):
        opened.plotter.iren.interactor.InvokeEvent("TimerEvent")
        np.testing.assert_allclose(opened.view.colours[:, :3], shaded(preview, "plain", eye), atol=1e-5)
    assert "suns in harmonics" in status(opened)
    press(opened, "u")
    tick_until_refined(opened)
    np.testing.assert_array_equal(opened.view.colours, refined)
    press(opened, "n")
    assert "suns" not in status(opened)


def test_a_saved_picture_is_refined(opened, monkeypatch) -> None:
    at_once = bare_picture(opened)
    monkeypatch.setattr(windows, "_STILL", 0.0)
    tick_until_refined(opened)
    np.testing.assert_array_equal(bare_picture(opened), at_once)
    press(opened, "u")
    assert np.abs(bare_picture(opened) - at_once).max() > 3.0


def test_a_directional_light_is_refined_too(tmp_path) -> None:
    asset = lobed()
    preview = Preview(asset, [LightSource("sun:1,2,3:4,4,4", asset.up, asset.degree)], rotation=25.0)
    turned = environment.rotation(25.0, "y") @ np.array([1.0, 2.0, 3.0]) / math.sqrt(14.0)
    preview.refine(EYE)
    seen = facing(asset.mesh, EYE) & asset.valid
    other = Preview(asset, [LightSource(f"sun:{','.join(map(repr, turned.tolist()))}:4,4,4", "y", asset.degree)])
    other.refine(EYE)
    np.testing.assert_allclose(preview.colours(EYE)[seen], other.colours(EYE)[seen], rtol=1e-5)
    assert np.abs(preview.colours(EYE)[:, :3] - shade(asset, other.light.harmonics, EYE))[seen].max() > 0.01
