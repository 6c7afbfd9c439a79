"""Assets and meshes for PyVista, and the window from Python."""

import dataclasses
import doctest
import io
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import pyvista as pv
from PIL import Image

import prt_bake as prt
from formats.asset import write_asset
from formats.errors import LightError, QueryError
from formats.image import write_image
from formats.image.png import to_srgb
from formats.mesh import write_mesh
from prt_bake.lights.lighting import as_lighting
from prt_bake.preview import plotter as plotters
from prt_bake.preview import show as shows
from prt_bake.preview.window import Window
from tests.shading.test_picture import constant, make_asset, painted_sky
from tests.shapes import ball

EYE = [0.5, 1.0, 4.0]
SKY = 0.3 * painted_sky()
VALID = np.arange(66) % 5 != 2
ASSET = make_asset(ball(2), valid=VALID)
ONE_LIGHT = dataclasses.replace(make_asset(ball(2), degree=0, quantity="radiance"), degree=2)


def test_the_mesh_holds_the_radiance_of_shade_and_its_srgb() -> None:
    lighting = prt.read_lighting("sun:0,1,0:3,2,1:20")
    mesh = ASSET.to_pyvista(lighting, EYE)
    expected = prt.shade(ASSET, prt.light_for(ASSET, lighting), EYE)
    assert isinstance(mesh, pv.PolyData)
    assert (mesh["radiance"].dtype, mesh["rgb"].dtype) == (np.float32, np.uint8)
    np.testing.assert_allclose(mesh["radiance"], expected, rtol=1e-6)
    assert not mesh["rgb"][~VALID].any()
    np.testing.assert_array_equal(mesh["rgb"], np.rint(255.0 * to_srgb(expected)))
    np.testing.assert_array_equal(mesh.points, ASSET.mesh.positions)
    np.testing.assert_array_equal(mesh.regular_faces, ASSET.mesh.faces)
    np.testing.assert_allclose(mesh.active_normals, ASSET.mesh.normals, atol=1e-7)
    assert mesh.active_scalars_name == "rgb"


def test_a_light_has_many_forms(tmp_path) -> None:
    write_image(tmp_path / "sky.exr", SKY)
    light = prt.project_environment(SKY)
    expected = ASSET.to_pyvista(light, EYE)["radiance"]
    path = tmp_path / "sky.exr"
    prepared = prt.light_for(ASSET, prt.read_lighting(path))
    for form in (path, str(path), SKY, prt.read_lighting(path), prepared, light.tolist()):
        np.testing.assert_allclose(ASSET.to_pyvista(form, EYE)["radiance"], expected, rtol=1e-4, atol=1e-6)


def test_the_defaults_are_the_shipped_sky_and_the_fitted_camera() -> None:
    sky = Path(prt.__file__).parent / "shipped" / "sky.hdr"
    eye = prt.fit_camera(ASSET.mesh, up=ASSET.up).eye
    np.testing.assert_array_equal(ASSET.to_pyvista()["radiance"], ASSET.to_pyvista(sky, eye)["radiance"])
    assert ONE_LIGHT.to_pyvista()["radiance"].any()


@pytest.mark.parametrize(
    ("asset", "light", "eye", "kind", "message"),
    [
        (ASSET, "none.exr", EYE, prt.PrtbakeError, r"none\.exr"),
        (ASSET, "spot.obj", EYE, LightError, "is not a light"),
        (ASSET, "", EYE, LightError, "is not a light"),
        (ASSET, [[1.0], [1.0, 2.0]], EYE, QueryError, "expected numbers in an array of one shape"),
        (ASSET, np.ones((4, 3)), EYE, QueryError, r"expected shape \[9, 3\]"),
        (ASSET, constant(), [0.0, 0.0, 0.0], QueryError, "inside the object"),
        (ONE_LIGHT, constant(), EYE, QueryError, "made for one light"),
        (ONE_LIGHT, "sky.hdr", EYE, QueryError, "made for one light"),
    ],
)
def test_unusable_lights_and_eyes_are_refused(asset, light, eye, kind, message) -> None:
    with pytest.raises(kind, match=message):
        asset.to_pyvista(light, eye)


def test_a_mesh_alone_has_its_normals() -> None:
    mesh = ASSET.mesh.to_pyvista()
    assert mesh.n_points == 66
    np.testing.assert_allclose(mesh["Normals"], ASSET.mesh.normals, atol=1e-7)


def test_the_examples_work(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_asset(make_asset(ball(2)), tmp_path / "spot.h5")
    write_mesh(ASSET.mesh, tmp_path / "spot.obj")
    write_image(tmp_path / "sky.hdr", SKY)
    for method in (prt.Asset.to_pyvista, prt.Mesh.to_pyvista):
        test = doctest.DocTestParser().get_doctest(method.__doc__ or "", {}, method.__name__, None, None)
        report: list[str] = []
        assert doctest.DocTestRunner().run(test, out=report.append).attempted >= 1
        assert not report, "".join(report)


@pytest.fixture
def notebook(monkeypatch):
    """PyVista as in a notebook; the plotters that it opens are closed."""
    monkeypatch.setattr(pv.global_theme, "notebook", True)
    yield
    pv.close_all()


def image_of(widget) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(widget.children[0].value)))


@pytest.mark.usefixtures("notebook")
def test_a_notebook_has_sliders_for_the_light_and_the_eye() -> None:
    asset = make_asset(ball(2), provenance={"eta": 1.5})
    widget = asset.show(as_lighting(0.1 * SKY, "y", 0.0), EYE)  # dark enough to show a reflection
    first = image_of(widget)
    assert first.shape == (600, 800, 3)
    controls = {control.description: control for control in widget.children[1].children}
    assert list(controls) == ["light", "exposure", "around", "above", "AgX", "reflection"]
    for name, value in (
        ("light", 90.0),
        ("exposure", -1.0),
        ("around", 45.0),
        ("above", -20.0),
        ("AgX", True),
        ("reflection", True),
    ):
        control = controls[name]
        before = control.value
        control.value = value
        assert np.abs(image_of(widget).astype(float) - first).mean() > 0.3, name
        control.value = before
        np.testing.assert_array_equal(image_of(widget), first)


@pytest.mark.usefixtures("notebook")
def test_the_picture_in_a_notebook_is_that_of_shade() -> None:
    lighting = as_lighting(SKY, "y", 0.0)
    found = image_of(ASSET.show(lighting, EYE))
    picture = prt.render_picture(ASSET, lighting, prt.fit_camera(ASSET.mesh, 800, 600, eye=EYE), samples=1)
    assert np.median(np.abs(found - 255.0 * to_srgb(picture.image))) <= 1.0


@pytest.mark.usefixtures("notebook")
def test_a_notebook_without_ipywidgets_or_with_one_light(monkeypatch) -> None:
    names = [control.description for control in ONE_LIGHT.show().children[1].children]
    assert names == ["exposure", "around", "above", "AgX"]
    monkeypatch.setattr(shows.importlib.util, "find_spec", lambda name: None)
    assert np.asarray(ONE_LIGHT.show()).shape == (600, 800, 3)


def test_a_script_shows_the_window(monkeypatch) -> None:
    seen: list[Window] = []
    monkeypatch.setattr(pv, "OFF_SCREEN", True)
    monkeypatch.setattr(plotters, "_IN_MEMORY", ("none",))
    monkeypatch.setattr(Window, "run", lambda self: seen.append(self))
    assert ONE_LIGHT.show(eye=EYE) is None
    np.testing.assert_allclose(seen[0].view.eye, EYE)
    seen[0].plotter.close()


@pytest.mark.parametrize(
    ("asset", "light", "message"),
    [
        (ASSET, 3, "expected the path of a light, or what prt.read_lighting returns, found 3"),
        (ONE_LIGHT, "sky.hdr", "made for one light"),
        (ASSET, None, "there is no display for the window; asset.to_pyvista"),
    ],
)
def test_what_cannot_be_shown_is_refused(asset, light, message, monkeypatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(QueryError, match=message):
        asset.show(light)


WITHOUT = """
import sys
sys.modules["pyvista"] = None
import prt_bake as prt
with prt.read_asset(sys.argv[1]) as asset:
    for call in (asset.to_pyvista, asset.mesh.to_pyvista, asset.show):
        try:
            call()
        except prt.PrtbakeError as error:
            print(error)
"""


def test_without_pyvista_the_message_names_what_to_install(tmp_path) -> None:
    write_asset(ASSET, tmp_path / "asset.h5")
    command = [sys.executable, "-c", WITHOUT, str(tmp_path / "asset.h5")]
    ran = subprocess.run(command, capture_output=True, text=True, check=True)
    assert ran.stdout.splitlines() == [
        f"{task}: pyvista is not installed; pip install pyvista" for task in ("to_pyvista", "to_pyvista", "show")
    ]
