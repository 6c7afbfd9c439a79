"""Records and their methods name the argument that is wrong, as functions do."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import prt_bake as prt
from tests.shading.test_picture import make_asset
from tests.shapes import ball

MESH = ball(2)
ASSET = make_asset(MESH)
LIGHT, SKY = np.ones((9, 3)), np.ones((8, 16, 3), np.float32)
LIGHTING = prt.read_lighting("sun:0,1,0")
EYE = np.array([0.0, 0.0, 5.0])
UP = np.array([[0.0, 0.0, 1.0]])
NETWORK = prt.NeuralBSSRDF()
SPOT = prt.load_model(prt.example("spot.pt")).on(prt.read_mesh(prt.example("spot.obj")))


def camera(**arguments: Any) -> prt.Camera:
    given = {"eye": EYE, "target": np.zeros(3), "up": np.eye(3)[1], "fov": 30.0, "width": 8, "height": 8}
    return prt.Camera(**(given | arguments))


def frames() -> prt.Frames:
    lit = prt.Frames(ASSET)
    lit.light(LIGHT)
    return lit


LIGHTS = r"; prt.read_lighting\(\[...\]\) reads several lights together"
WRONG: dict[str, tuple[Callable[[], Any], str]] = {
    "eye text": (lambda: camera(eye="0,1,2"), "eye: expected an array of numbers, found the text '0,1,2'"),
    "eye none": (lambda: camera(eye=None), "eye: expected real numbers, found None"),
    "eye pair": (lambda: camera(eye=[1, 2]), r"camera: expected three finite numbers for eye, found \[1.0, 2.0\]"),
    "eye matrix": (lambda: camera(eye=np.eye(3)), r"three finite numbers for eye, found shape \[3, 3\]"),
    "eye complex": (lambda: camera(eye=1j * EYE), "eye: expected real numbers, found complex128 values"),
    "up text": (lambda: camera(up="y"), "up: expected an array of numbers, found the text 'y'"),
    "fov text": (lambda: camera(fov="30"), "fov must be a number, found the text '30'"),
    "fov array": (lambda: camera(fov=np.array([30.0])), r"fov must be a number, found an array \[1\]"),
    "fov complex": (lambda: camera(fov=np.complex64(30.0)), "fov must be a number, found an array"),
    "fov bool": (lambda: camera(fov=np.True_), "fov must be a number, found an array"),
    "width share": (lambda: camera(width=8.5), "width must be a whole number, found 8.5"),
    "width bool": (lambda: camera(width=True), "width must be a whole number, found True"),
    "extent text": (lambda: camera(extent="wide"), "extent must be a number, found the text 'wide'"),
    "huge": (lambda: camera(width=200_000, height=200_000), "at most 268,435,456 pixels, found 200000x200000"),
    "fit huge": (lambda: prt.fit_camera(MESH, 200_000, 200_000), "at most 268,435,456 pixels"),
    "skies text": (lambda: prt.Lighting("sky.hdr"), "skies: .* found the text 'sky.hdr'" + LIGHTS),
    "skies array": (lambda: prt.Lighting(SKY), r"skies: .* found an array \[8, 16, 3\] of float32"),
    "skies lightings": (lambda: prt.Lighting([LIGHTING]), "skies: .* found a lighting" + LIGHTS),
    "suns text": (lambda: prt.Lighting(suns=["sun:0,1,0"]), "suns: .* found the text 'sun:0,1,0'"),
    "turned text": (lambda: LIGHTING.turned("90", "y"), "degrees must be a number, found the text '90'"),
    "turned nan": (lambda: LIGHTING.turned(np.nan, "y"), "degrees: expected a finite number, found nan"),
    "seen from a point": (lambda: LIGHTING.radiance([0, 0, 1]), r"directions: expected shape \[N, 3\], found \[3\]"),
    "mesh text": (lambda: prt.Mesh("a", MESH.faces, MESH.normals), "mesh: positions: expected an array of numbers"),
    "mesh number": (lambda: prt.Mesh(3.0, MESH.faces, MESH.normals), r"mesh: positions: expected shape \[0, 3\]"),
    "mesh complex": (lambda: prt.Mesh(1j * MESH.positions, MESH.faces, MESH.normals), "found complex128 values"),
    "box text": (lambda: prt.NeuralBSSRDF(box_min="a"), "box_min: expected an array of numbers"),
    "box side text": (lambda: prt.NeuralBSSRDF(box_side="2"), "box_side must be a number, found the text '2'"),
    "box metadata": (lambda: prt.NeuralBSSRDF(metadata="x"), "metadata: expected a dictionary, found the text 'x'"),
    "no such device": (lambda: prt.NeuralBSSRDF().prepared(device="tpu"), "device: expected 'cpu', .* found 'tpu'"),
    "no GPU": (lambda: prt.NeuralBSSRDF().prepared(device="cuda"), "device: expected 'cpu', .* found 'cuda'"),
    "position nan": (
        lambda: NETWORK.evaluate(UP, np.nan * UP, UP),
        "positions: expected finite .* 1 of 1 that are not",
    ),
    "outgoing nan": (lambda: NETWORK.evaluate(UP, UP, np.nan * UP), "outgoing: expected unit vectors, .* length nan"),
    "position far": (
        lambda: SPOT.evaluate(UP, 99 * UP, UP),
        r"positions: .* its box .* 1 of 1 outside; the first, .* 99",
    ),
    "block nan": (
        lambda: SPOT.evaluate_block(UP[None], [[0]], np.nan * UP, UP[None]),
        "positions: expected finite numbers, found 1 of 1 that are not",
    ),
    "seen along nothing": (lambda: LIGHTING.radiance([[0, 0, 0]]), r"directions: expected unit .* such as \[0.0, 0.0"),
    "count text": (lambda: prt.sphere.fibonacci("9"), "count must be a whole number, found the text '9'"),
    "seed text": (lambda: prt.sphere.sobol(9, "x"), "seed must be a whole number, found the text 'x'"),
    "frames apart": (
        lambda: prt.sphere.to_local(UP, [[0, 0, 1]] * 2, [[1, 0, 0]] * 3),
        r"found \[1, 3\], \[2, 3\], \[3",
    ),
    "coefficients flat": (
        lambda: prt.write_asset(dataclasses.replace(ASSET, coefficients=np.ones((3, 3))), "a.h5"),
        r"a.h5: coefficients have shape \[3, 3\]; expected \[V, B, K, 3\]",
    ),
    "frame turned": (lambda: frames().turn("90"), "degrees must be a number, found the text '90'"),
    "frame culled": (lambda: frames().draw(EYE, cull="no"), "cull: expected True or False, found the text 'no'"),
    "frame held": (lambda: frames().hold(EYE, cull=1), "cull: expected True or False, found 1"),
    "frame eyes": (lambda: frames().draw(MESH.normals), r"eye: expected a point .* found shape \[66, 3\]"),
    "shown light": (lambda: ASSET.show(light=[3]), "light: expected the path of a light, .* found a list"),
    "plotted light": (lambda: ASSET.to_pyvista(MESH), "light: expected real numbers, found a mesh"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_record_names_the_argument_and_what_was_found(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    call, sentence = WRONG[name]
    with pytest.raises(prt.PrtbakeError, match=sentence):
        call()


def test_records_take_numbers_of_any_library_and_lists_of_lights() -> None:
    made = camera(eye=(0, 0, 5), width=np.int64(8), fov=np.float32(30.0))
    assert (type(made.width), made.fov, made.eye.tolist()) == (int, 30.0, [0.0, 0.0, 5.0])
    assert prt.Lighting(suns=list(LIGHTING.suns)).suns == prt.Lighting(suns=LIGHTING.suns[0]).suns == LIGHTING.suns
    lists = prt.Mesh(MESH.positions.tolist(), MESH.faces.astype(">u4"), np.asfortranarray(MESH.normals))
    np.testing.assert_array_equal(lists.faces, MESH.faces)
    np.testing.assert_array_equal(ASSET.to_pyvista(SKY.tolist())["rgb"], ASSET.to_pyvista(SKY)["rgb"])


def test_a_closed_asset_is_refused_by_name(tmp_path: Any) -> None:
    prt.write_asset(ASSET, tmp_path / "a.h5")
    asset = prt.read_asset(tmp_path / "a.h5", load=False)
    asset.close()
    calls = [
        lambda: prt.shade(asset, LIGHT, EYE),
        lambda: prt.compress(asset, 0.1),
        lambda: prt.Frames(asset),
        lambda: asset.to_pyvista(LIGHT),
        lambda: asset.show(),
    ]
    for call in calls:
        with pytest.raises(prt.QueryError, match="asset: its file is closed; read it again"):
            call()


def test_a_sky_that_lies_on_its_side_is_reported() -> None:
    upright = dataclasses.replace(ASSET, up="z")
    sky = prt.read_lighting(prt.example("sky.hdr"))
    for show in (
        lambda: prt.light_for(upright, sky),
        lambda: prt.render_picture(upright, sky, prt.fit_camera(MESH, 4, 4, up="z")),
    ):
        with pytest.warns(prt.InputWarning, match='with y up, but z points up here; read it with .*up="z"'):
            show()
    prt.render_picture(upright, sky, prt.fit_camera(MESH, 4, 4), up="y")
    prt.light_for(upright, LIGHTING)


def test_every_error_that_a_docstring_names_is_public() -> None:
    import re

    for name in prt.__all__:
        named = set(re.findall(r"\b\w+(?:Error|Warning)\b", getattr(prt, name).__doc__ or ""))
        assert named - {"TypeError", "ValueError", "UserWarning"} <= set(prt.__all__), name


def test_an_asset_made_for_one_eye_says_so_under_another() -> None:
    settings = {"settings": {"for_eye": [0.0, 0.0, 9.0]}}
    asset = dataclasses.replace(ASSET, provenance=settings)
    prt.shade(asset, LIGHT, [0.0, 0.0, 9.0])
    drawn = prt.Frames(asset)
    drawn.light(LIGHT)
    for show in (
        lambda: prt.shade(asset, LIGHT, EYE),
        lambda: prt.render_picture(asset, SKY, camera()),
        lambda: drawn.draw(EYE),
    ):
        with pytest.warns(
            prt.InputWarning, match=r"made for the eye \[0.0, 0.0, 9.0\]: from other positions its colours"
        ):
            show()
