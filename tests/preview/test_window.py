"""The preview's input: keys, mouse, sliders, changed and dropped files, and the reference picture."""

import dataclasses
import os
import signal
import threading
from pathlib import Path

import numpy as np
import pytest
from vtkmodules.vtkCommonCore import vtkStringArray

from formats.errors import StorageError
from formats.image import read_image
from prt_bake.geometry.camera import Camera
from prt_bake.lights.lighting import as_lighting
from prt_bake.preview import window as windows
from prt_bake.preview.state import Mode
from prt_bake.preview.window import Window
from prt_bake.shading.picture import render_picture
from prt_bake.shading.tone_map import agx
from tests.preview.windows import bare_picture, drag, encoded, mouse, open_window, press, slide, write_sky
from tests.shading.test_picture import constant, make_asset, painted_sky
from tests.shapes import ball

SKY = 0.2 * painted_sky()


@pytest.fixture(autouse=True)
def _own_folder(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def opened(tmp_path):
    """A window on a ball with two skies, the second one white."""
    lights = [write_sky(tmp_path / "sky.exr", SKY), write_sky(tmp_path / "white.exr", 0.3 * constant())]
    window = open_window(make_asset(ball(2), provenance={"eta": 1.5}), lights)
    yield window
    window.plotter.close()


def texts_of(window: Window) -> str:
    overlay = window.overlay
    texts = (overlay.legend, overlay.status, overlay.message)
    return "\n".join(" ".join(text.GetInput().split("\n")) for text in texts if text.GetVisibility())


def camera_of(window: Window) -> Camera:
    """Return the window's camera in object space."""
    view = window.view
    camera = view.plotter.camera
    target = view.preview.asset.mesh.center + view.radius * np.array(camera.focal_point)
    width, height = view.plotter.window_size
    return Camera(view.eye, target, np.array(camera.up), camera.view_angle, width, height)


def test_orbiting_shades_for_every_eye(opened) -> None:
    before, eye = opened.view.colours.copy(), opened.view.eye
    drag(opened, (60, 45), (90, 52))
    assert np.linalg.norm(opened.view.eye - eye) > 0.3
    assert np.linalg.norm(opened.view.eye) == pytest.approx(np.linalg.norm(eye), rel=1e-5)
    assert np.abs(opened.view.colours - before).max() > 1e-3  # drawn during the movement
    picture = render_picture(opened.view.preview.asset, as_lighting(SKY, "y", 0.0), camera_of(opened), samples=4)
    off = np.abs(bare_picture(opened) - encoded(picture.image)).max(axis=2)
    assert np.quantile(off[(picture.coverage == 1.0) | (picture.coverage == 0.0)], 0.98) <= 1.0
    press(opened, "0")
    np.testing.assert_allclose(opened.view.eye, eye, rtol=1e-6)
    np.testing.assert_array_equal(opened.view.colours, before)


def test_edges_are_antialiased_except_during_movement(opened, monkeypatch) -> None:
    assert opened.view.smooth_edges
    drag(opened, (60, 45), (90, 52))
    assert not opened.view.smooth_edges
    monkeypatch.setattr(windows, "_STILL", 0.0)
    opened.plotter.iren.interactor.InvokeEvent("TimerEvent")
    assert opened.view.smooth_edges


def test_keys_perform_their_actions(opened) -> None:
    preview = opened.view.preview
    press(opened, "n")
    assert preview.current == 1
    assert "white.exr" in texts_of(opened)
    press(opened, "N")
    assert preview.current == 0
    press(opened, "Up", "Up", "Down", "Left")
    assert (preview.exposure, preview.rotation) == (0.5, -5.0)
    assert opened.exposure.GetRepresentation().GetValue() == pytest.approx(0.5)
    assert opened.rotation.GetRepresentation().GetValue() == pytest.approx(-5.0)
    press(opened, "e")
    assert preview.mode is Mode.ERROR
    press(opened, "v")
    assert preview.mode is Mode.VALID
    assert "all valid" in texts_of(opened)
    press(opened, "period", "period")
    assert preview.degree_and_order == (1, 0)
    assert "l = 1, m = 0" in texts_of(opened)
    press(opened, "comma", "c")
    assert preview.mode is Mode.RADIANCE
    press(opened, "r")
    assert preview.reflecting
    assert "with reflection" in texts_of(opened)


def test_every_mode_and_every_key_changes_the_picture(opened) -> None:
    press(opened, "Down", "Down", "Down")
    seen = [bare_picture(opened)]
    for key in ("e", "v", "c", "period", "c", "b", "b", "r", "r", "Up", "Down", "n", "n", "Right", "Left"):
        press(opened, key)
        seen.append(bare_picture(opened))
        assert np.abs(seen[-1] - seen[-2]).mean() > 0.01, key
    np.testing.assert_array_equal(seen[0], seen[-1])


@pytest.mark.parametrize("key", ["h", "question"])
def test_the_legend_opens_and_closes(opened, key) -> None:
    assert "h: keys" in texts_of(opened)
    press(opened, key)
    for text in ("orbit", "next light of 2", "reflection", "standard error", "valid", "coefficients", "quit"):
        assert text in texts_of(opened)
    assert "flip" not in texts_of(opened)
    press(opened, key)
    assert "orbit" not in texts_of(opened)


def test_the_keys_of_vtk_do_nothing(opened) -> None:
    before = bare_picture(opened)
    press(opened, "w", "3", "f", "p", "i", "j", "l", "plus")
    np.testing.assert_array_equal(bare_picture(opened), before)


def test_sliders_set_rotation_and_exposure(opened) -> None:
    preview = opened.view.preview
    slide(opened.rotation, 90.0)
    slide(opened.exposure, -2.0)
    assert (preview.rotation, preview.exposure) == (90.0, -2.0)
    assert "light +90°" in opened.overlay.rotation.GetInput()
    picture = render_picture(preview.asset, as_lighting(SKY, "y", 90.0), camera_of(opened), samples=4)
    off = np.abs(bare_picture(opened) - encoded(picture.image, -2.0)).max(axis=2)
    assert np.quantile(off[(picture.coverage == 1.0) | (picture.coverage == 0.0)], 0.98) <= 1.0


def test_an_exposure_beyond_the_slider_stays(tmp_path) -> None:
    lights = [write_sky(tmp_path / "sky.exr", SKY)]
    window = open_window(make_asset(ball(2)), lights, exposure=windows.SLIDER_EXPOSURE + 0.5)
    press(window, "Up")
    assert window.view.preview.exposure == windows.SLIDER_EXPOSURE + 1.0
    assert window.exposure.GetRepresentation().GetValue() == windows.SLIDER_EXPOSURE
    slide(window.exposure, 1.0)
    assert window.view.preview.exposure == 1.0


def test_agx_is_that_of_a_written_picture(opened) -> None:
    press(opened, *["Up"] * 6, "t")
    assert "AgX" in texts_of(opened)
    picture = render_picture(opened.view.preview.asset, as_lighting(SKY, "y", 0.0), camera_of(opened), samples=4)
    off = np.abs(bare_picture(opened) - encoded(agx(picture.image, 3.0))).max(axis=2)
    assert np.quantile(off[(picture.coverage == 1.0) | (picture.coverage == 0.0)], 0.98) <= 1.0
    press(opened, "v")
    valid = bare_picture(opened)
    press(opened, "v", "t", "v")
    np.testing.assert_array_equal(bare_picture(opened), valid)  # false colours stay as they are


@pytest.mark.parametrize(
    ("keys", "light", "message"),
    [
        ("n", "sky.exr", "there is one light"),
        ("r", "sun:1,2,3", "no reflection: sun:1,2,3 has no sky"),
        ("b", "sun:1,2,3", "no background: sun:1,2,3 has no sky"),
        ("er", "sky.exr", "not in this view: e returns"),
        ("vb", "sky.exr", "not in this view: v returns"),
        ("ct", "sky.exr", "not in this view: c returns"),
        ("u", "sky.exr", "no suns"),
        (["space"], "sky.exr", "there is no reference picture"),
    ],
)
def test_a_key_without_effect_says_why(tmp_path, keys, light, message) -> None:
    write_sky(tmp_path / "sky.exr", constant())
    window = open_window(make_asset(ball(2), provenance={"eta": 1.5}), [light])
    press(window, *keys)
    assert message in texts_of(window)
    window.plotter.close()


def test_keys_say_that_the_reference_hides_their_effect(tmp_path) -> None:
    lights = [write_sky(tmp_path / "sky.exr", SKY)]
    window = open_window(make_asset(ball(2)), lights, reference=np.ones((90, 120, 3), np.float32))
    press(window, "space", "t")
    assert "space returns to the object" in texts_of(window)
    assert window.view.preview.tone_map == "none"


def test_the_legend_does_not_lie_over_the_sliders(tmp_path) -> None:
    lights = [write_sky(tmp_path / "sky.exr", SKY)]
    for size, together in (((400, 300), True), ((120, 90), False)):
        window = open_window(make_asset(ball(2)), lights, size)
        press(window, "h")
        assert [window.exposure.GetEnabled(), window.rotation.GetEnabled()] == [together, together]
        press(window, "h")
        assert [window.exposure.GetEnabled(), window.rotation.GetEnabled()] == [True, True]
        window.plotter.close()


def tick_after(window: Window, path, content: bytes) -> None:
    before = path.stat().st_mtime_ns
    path.write_bytes(content)
    os.utime(path, ns=(before + 10_000_000, before + 10_000_000))
    window.plotter.iren.interactor.InvokeEvent("TimerEvent")


def test_a_sky_that_changes_on_disk_is_shown(opened, tmp_path, monkeypatch) -> None:
    first, path = bare_picture(opened), tmp_path / "sky.exr"
    whole, white = path.read_bytes(), (tmp_path / "white.exr").read_bytes()
    tick_after(opened, path, white[:300])
    np.testing.assert_array_equal(bare_picture(opened), first)
    assert "sky.exr" in texts_of(opened)
    assert "still showing" in texts_of(opened)
    tick_after(opened, path, white)
    assert bare_picture(opened)[2, 60] == pytest.approx(encoded(np.full(3, 0.3)), abs=1.0)
    tick_after(opened, path, whole)
    np.testing.assert_array_equal(bare_picture(opened), first)
    assert "was reloaded" in texts_of(opened)
    monkeypatch.setattr(windows, "_MESSAGE_SECONDS", 0.0)
    opened.plotter.iren.interactor.InvokeEvent("TimerEvent")
    assert not opened.overlay.message.GetVisibility()


def test_the_reference_is_shown_pixel_by_pixel(tmp_path) -> None:
    reference = np.random.default_rng(0).random((90, 120, 3)).astype(np.float32)
    asset, lights = make_asset(ball(2)), [write_sky(tmp_path / "sky.exr", SKY)]
    window = open_window(asset, lights, reference=reference)
    object_picture = bare_picture(window)
    press(window, "space")
    assert np.abs(bare_picture(window) - encoded(reference)).max() <= 1.0
    assert "reference.exr" in texts_of(window)
    press(window, "Up")
    assert np.abs(bare_picture(window) - encoded(reference, 0.5)).max() <= 1.0
    press(window, "Down", "space")
    np.testing.assert_array_equal(bare_picture(window), object_picture)
    window.plotter.close()
    large = open_window(asset, lights, (60, 60), reference=reference)
    press(large, "space")
    shown = bare_picture(large)
    assert shown[:7].std(axis=(0, 1)).max() == shown[-7:].std(axis=(0, 1)).max() == 0.0  # bars above and below
    assert shown[10:50].std() > 20.0


def test_an_eye_inside_the_object_is_reported_and_keeps_the_colours(opened) -> None:
    before = opened.view.colours.copy()
    camera = opened.plotter.camera
    camera.position = (0.0, 0.05, 0.1)
    opened.render()
    assert "inside the object" in texts_of(opened)
    np.testing.assert_array_equal(opened.view.colours, before)
    camera.position = (0.0, 0.05, 5.0)
    opened.render()
    assert not opened.overlay.message.GetVisibility()
    assert np.abs(opened.view.colours - before).max() > 1e-3


def test_a_saved_picture_has_no_texts_and_a_new_name(opened, tmp_path) -> None:
    press(opened, "h", "s", "s")
    names = sorted(path.name for path in tmp_path.glob("*.png"))
    assert names == ["ball_1.png", "ball_2.png"]
    np.testing.assert_array_equal(read_image("ball_1.png"), read_image("ball_2.png"))
    assert "orbit" in texts_of(opened)
    assert opened.overlay.legend.GetVisibility()
    press(opened, "h")
    assert opened.exposure.GetEnabled()


def test_a_failed_save_is_reported_and_the_window_stays(opened, monkeypatch) -> None:
    def full(path: Path, picture: np.ndarray) -> None:
        raise StorageError(f"{path}: cannot be written: the disk is full")

    monkeypatch.setattr(windows, "write_picture", full)
    press(opened, "s")
    assert "the disk is full" in texts_of(opened)
    assert opened.overlay.status.GetVisibility()
    assert opened.exposure.GetEnabled()


def test_an_asset_made_for_one_light_has_no_rotation_slider() -> None:
    asset = dataclasses.replace(make_asset(ball(2), degree=0, quantity="radiance"), degree=2)
    window = open_window(asset, [])
    assert not window.rotation.GetEnabled()
    assert window.exposure.GetEnabled()
    before = bare_picture(window)
    for key in ("Left", "n", "r", "b"):
        press(window, key)
        assert "made for one light" in texts_of(window) or key == "r", key
    np.testing.assert_array_equal(bare_picture(window), before)


def drop(window: Window, *paths: Path) -> None:
    names = vtkStringArray()
    for path in paths:
        names.InsertNextValue(str(path))
    window.plotter.iren.interactor.InvokeEvent("DropFilesEvent", names)


def test_a_dropped_sky_becomes_the_light(opened, tmp_path) -> None:
    write_sky(tmp_path / "dropped.exr", 0.6 * constant())
    (tmp_path / "none.exr").write_bytes(b"no picture")
    drop(opened, tmp_path / "dropped.exr")
    assert "dropped.exr" in texts_of(opened)
    assert bare_picture(opened)[2, 60] == pytest.approx(encoded(np.full(3, 0.6)), abs=1.0)
    drop(opened, tmp_path / "none.exr")
    assert "no" in texts_of(opened)
    assert "is not OpenEXR" in " ".join(texts_of(opened).split())
    assert "dropped.exr" in opened.overlay.status.GetInput()
    press(opened, "n", "n", "n")
    assert "dropped.exr" in texts_of(opened)
    write_sky(tmp_path / "white.exr", 0.9 * constant())
    drop(opened, tmp_path / "white.exr")
    assert len(opened.view.preview.lights) == 3  # the light was known
    assert bare_picture(opened)[2, 60] == pytest.approx(encoded(np.full(3, 0.9)), abs=1.0)


def test_an_asset_made_for_one_light_refuses_a_dropped_sky(tmp_path) -> None:
    asset = dataclasses.replace(make_asset(ball(2), degree=0, quantity="radiance"), degree=2)
    window = open_window(asset, [])
    drop(window, Path(write_sky(tmp_path / "sky.exr", SKY)))
    assert "made for one light" in texts_of(window)
    window.plotter.close()


def test_the_status_line_shows_that_kernels_are_loading(opened, monkeypatch) -> None:
    until = threading.Event()
    monkeypatch.setattr(opened.view.preview, "load", until.wait)
    opened.view.preview.load_in_background()
    opened.plotter.iren.interactor.InvokeEvent("TimerEvent")
    assert "loading kernels" in texts_of(opened)
    until.set()
    opened.view.preview._loader.join()
    opened.plotter.iren.interactor.InvokeEvent("TimerEvent")
    assert "loading kernels" not in texts_of(opened)


def test_a_window_that_is_destroyed_from_outside_ends(opened, monkeypatch) -> None:
    ended, destroyed = [], []
    monkeypatch.setattr(opened, "_quit", lambda: ended.append(True))
    monkeypatch.setattr(opened, "_destroyed", lambda: bool(destroyed))
    opened.tick()
    assert not ended
    destroyed.append(True)
    opened.tick()
    assert ended


def test_ctrl_c_closes_the_window_without_an_exception(opened, monkeypatch) -> None:
    ended = []
    monkeypatch.setattr(opened, "_quit", lambda: ended.append(True))

    def show() -> None:
        """An event loop with Ctrl-C between two timer events."""
        opened.tick()
        assert not ended
        signal.raise_signal(signal.SIGINT)
        opened.tick()

    monkeypatch.setattr(opened.plotter, "show", show)
    opened.run()
    assert ended == [True]
    assert opened.interrupted == signal.SIGINT
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_drag_ends_with_the_mouse(opened) -> None:
    interactor = opened.plotter.iren.interactor
    mouse(opened, (60, 45), "MouseMoveEvent", "LeftButtonPressEvent")
    mouse(opened, (70, 45), "MouseMoveEvent")
    eye = opened.view.eye
    interactor.InvokeEvent("TimerEvent")
    np.testing.assert_array_equal(opened.view.eye, eye)
    mouse(opened, (70, 45), "LeftButtonReleaseEvent")


def test_the_mouse_moves_a_slider_even_after_a_pan(opened) -> None:
    target = np.array(opened.plotter.camera.focal_point)
    mouse(opened, (60, 45), "LeftButtonPressEvent", shift=True)
    mouse(opened, (70, 45), "MouseMoveEvent", "LeftButtonReleaseEvent", shift=True)
    assert np.linalg.norm(opened.plotter.camera.focal_point - target) > 0.01
    eye = opened.view.eye
    knob = round(120 * (0.56 + 0.75) / 2), round(90 * 0.07)
    mouse(opened, knob, "MouseMoveEvent", "LeftButtonPressEvent")
    mouse(opened, (knob[0] + 5, knob[1]), "MouseMoveEvent", "LeftButtonReleaseEvent")
    assert 40.0 < opened.view.preview.rotation < 120.0
    np.testing.assert_array_equal(opened.view.eye, eye)
