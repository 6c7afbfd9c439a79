"""The page in Chromium, by WebGL 2 and by WebGPU: its radiance and its pictures are those of `prt.shade`."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import prt_bake as prt
from formats.asset import Asset, read_asset, write_asset
from prt_bake.baking.compress import compress, unpacked
from prt_bake.export.engine_form import engine_form
from prt_bake.export.gltf import export_gltf
from prt_bake.mathematics import sh
from prt_bake.shipped.examples import example
from tests.engines.conftest import RunNode
from tests.engines.pages import BACKENDS, camera_of, drive, make_site, relative_rms
from tests.engines.pictures import soft_asset
from tests.export.assets import smooth_asset
from tests.formats.asset.test_asset import make_asset
from tests.formats.asset.test_compact import compact_asset
from tests.formats.mesh.gltf_files import GltfBuilder

pytestmark = pytest.mark.usefixtures("chromium")


def light_of(degree: int) -> np.ndarray:
    """A coloured light without symmetry [K,3], whose radiance is mostly positive."""
    light = np.random.default_rng(5).normal(size=(sh.count(degree), 3)) * 0.3
    light[0] = [3.0, 2.0, 1.5]
    return light


def pruned(asset: Asset, **axes: slice) -> Asset:
    """An asset whose axis of views or channels has length 1."""
    views, channels = axes.get("views", slice(None)), axes.get("channels", slice(None))
    return dataclasses.replace(
        asset, coefficients=asset.coefficients[:, views, :, channels], standard_error=asset.standard_error[:, views]
    )


def partly_baked() -> Asset:
    asset = smooth_asset()
    valid = np.arange(len(asset.valid)) % 5 > 0
    return dataclasses.replace(
        asset,
        valid=valid,
        coefficients=asset.coefficients * valid[:, None, None, None],
        standard_error=asset.standard_error * valid[:, None],
    )


ASSETS: dict[str, Callable[[], Asset]] = {
    "half floats, z up": lambda: soft_asset("z", "mm"),
    "degree 3, away from the origin": lambda: smooth_asset(degree=3),
    "degree 0": lambda: smooth_asset(degree=0),
    "one view": lambda: pruned(smooth_asset(), views=slice(0, 1)),
    "one channel": lambda: pruned(smooth_asset(), channels=slice(0, 1)),
    "odd numbers": lambda: make_asset(vertices=7, rings=3, sectors=5, storage="float16"),
    "one ring": lambda: make_asset(vertices=7, rings=1, sectors=1, storage="float32"),
    "partly baked": partly_baked,
    "compact": lambda: compress(smooth_asset(), 0.01),
    "compact, products of rings and sectors": lambda: compact_asset(vertices=40, rings=4, sectors=6, learned=False),
    "compact, one view": lambda: compact_asset(vertices=40, views=1, learned=False, channels=1),
    "compact, wide codes": lambda: compact_asset(vertices=40, rings=4, sectors=6, largest=2**24),
}


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", ASSETS)
def test_vertices_of_assets(name: str, backend: str, run_node: RunNode, tmp_path: Path) -> None:
    made = ASSETS[name]()
    made = dataclasses.replace(made, check_values=sh.evaluate(made.check_directions, made.degree))
    write_asset(made, tmp_path / "asset.h5")
    asset = read_asset(tmp_path / "asset.h5")
    light, middle = light_of(asset.degree), asset.mesh.positions.mean(axis=0)
    away = 3.0 * np.ptp(asset.mesh.positions, axis=0).max()
    eyes = middle + away * np.array([[0.3, 0.2, 1.0], [-1.0, 0.1, -0.2], [0.1, -1.0, 0.3]])
    steps = [["ready"], ["state"], *(["radiance", eye.tolist(), light.ravel().tolist()] for eye in eyes)]
    _, state, *found = drive(
        run_node, make_site(tmp_path / "site", [tmp_path / "asset.h5"]), steps, **BACKENDS[backend]
    )
    assert state["backend"] == backend
    assert state["message"] == ""
    for eye, radiance in zip(eyes, found, strict=True):
        assert relative_rms(radiance, prt.shade(asset, light, eye)) < 1e-3


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    ("degree", "quantize", "folded", "up"), [(3, None, False, "y"), (5, "int8", False, "z"), (2, None, True, "y")]
)
def test_vertices_of_glb(
    degree: int, quantize: Any, folded: bool, up: str, backend: str, run_node: RunNode, tmp_path: Path
) -> None:
    asset, light = smooth_asset(up=up, unit="cm"), light_of(2)
    path = tmp_path / "asset.glb"
    export_gltf(asset, path, degree, quantize=quantize, light=light if folded else None, light_name="a light")
    eye = asset.mesh.positions.mean(axis=0) + np.array([3.0, 2.0, 6.0])
    steps = [["ready"], ["state"], ["radiance", eye.tolist(), light.ravel().tolist()]]
    _, state, found = drive(run_node, make_site(tmp_path / "site", [path]), steps, **BACKENDS[backend])
    form = engine_form(asset, degree, light if folded else None)
    outgoing = eye - asset.mesh.positions
    outgoing /= np.linalg.norm(outgoing, axis=1, keepdims=True)
    expected = form.radiance(np.arange(len(outgoing)), outgoing, np.ones((1, 3)) if folded else light)
    assert relative_rms(found, np.maximum(expected, 0.0)) < (5e-3 if quantize else 1e-4)
    assert state["selftest"] < 1e-5
    assert state["check"] == "meets its self-test"
    assert state["lights"] is not folded


def test_all_parts_of_a_users_file_are_shown(run_node: RunNode, tmp_path: Path) -> None:
    """Two nodes, one of them turned and mirrored, each with half of the baked faces."""
    asset, light, user = smooth_asset(), light_of(2), GltfBuilder()
    halves = np.array_split(asset.mesh.faces, 2)
    for faces, scale, shift in zip(
        halves, ([1.0, 1.0, 1.0], [2.0, -1.0, 0.5]), ([0.0, 0.0, 0.0], [1, 2, 3]), strict=True
    ):
        local = (asset.mesh.positions - shift)[faces.ravel()] / scale
        normals = asset.mesh.normals[faces.ravel()] * scale
        part = user.solid(
            local, np.arange(len(local)), NORMAL=user.accessor(normals / np.linalg.norm(normals, axis=1)[:, None])
        )
        user.node(mesh=user.mesh(part), scale=scale, translation=shift)
    user.write(tmp_path / "user.glb")
    export_gltf(asset, tmp_path / "onto.glb", 3, onto=tmp_path / "user.glb")
    eye = asset.mesh.positions.mean(axis=0) + np.array([3.0, 2.0, 6.0])
    steps = [["ready"], ["state"], ["radiance", eye.tolist(), light.ravel().tolist()]]
    _, state, found = drive(run_node, make_site(tmp_path / "site", [tmp_path / "onto.glb"]), steps, **BACKENDS["webgl"])
    vertices = np.concatenate([faces.ravel() for faces in halves])
    outgoing = eye - asset.mesh.positions[vertices]
    outgoing /= np.linalg.norm(outgoing, axis=1, keepdims=True)
    expected = engine_form(asset, 3).radiance(vertices, outgoing, light)
    assert relative_rms(found, np.maximum(expected, 0.0)) < 1e-4
    assert state["check"] == "meets its self-test"
    assert state["figures"].startswith("320 triangles · 960 vertices · ")


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("kind", ["plain", "compact"])
def test_a_bake(kind: str, backend: str, spot: Path, run_node: RunNode, tmp_path: Path) -> None:
    """The self-test, the light, vertices and a picture of a baked object, plain and compact."""
    asset = read_asset(spot / "spot.h5")
    if kind == "compact":
        write_asset(compress(asset, 0.005), tmp_path / "spot.h5")
        asset = read_asset(tmp_path / "spot.h5")
    path = (spot if kind == "plain" else tmp_path) / "spot.h5"
    sky, camera, eye = prt.read_environment(spot / "sky.hdr"), prt.fit_camera(asset.mesh, 120, 90), [-1.0, 2.0, 3.0]
    light = prt.rotate_light(prt.project_environment(sky, up=asset.up), 30.0, asset.up).ravel().tolist()
    steps: list[Any] = [["ready"], ["state"], ["radiance", eye, light], ["picture", camera_of(camera, 3), light]]
    site = make_site(tmp_path / "site", [path], [spot / "sky.hdr"])
    _, state, radiance, rows = drive(run_node, site, steps, **BACKENDS[backend])
    assert state["selftest"] < 1e-3
    assert state["check"] == "meets its self-test"
    assert state["figures"].startswith("5,856 triangles · 2,930 vertices · ")
    assert relative_rms(radiance, prt.shade(asset, np.reshape(light, (-1, 3)), eye)) < 1e-3
    lighting = prt.read_lighting(str(spot / "sky.hdr"), rotate=30.0)
    picture = prt.render_picture(unpacked(asset), lighting, camera, suns="plain", background=False)
    found = np.reshape(rows, (90, 3, 120, 3, 4)).mean(axis=(1, 3))
    assert relative_rms(found[..., :3], picture.image) < 0.02
    print(f"{kind} {backend}: opened in {state['opened']:.0f} ms; frames {np.round(state['frames'], 1)} ms")


def test_the_light_of_a_sky(run_node: RunNode, tmp_path: Path) -> None:
    """The page's own projection, turned by its slider, agrees with `prt.project_environment` and `prt.rotate_light`."""
    for up in ("y", "z"):
        write_asset(smooth_asset(up=up, degree=3), tmp_path / f"{up}.h5")
    sky = prt.read_environment(example("sky.hdr"))
    prt.write_image(tmp_path / "small.hdr", np.random.default_rng(0).random((5, 10, 3)).astype(np.float32))
    prt.write_image(tmp_path / "small.exr", np.random.default_rng(1).random((6, 12, 3)).astype(np.float32))
    sun = np.full((750, 1500, 3), 0.5, np.float32)  # rows and columns that no pixel of the page's picture has alone
    sun[200:202, 301:303] = 30000.0
    prt.write_image(tmp_path / "sun.hdr", sun)
    site = make_site(tmp_path / "site", [tmp_path / "y.h5", tmp_path / "z.h5"], [example("sky.hdr")])
    steps = [["ready"], ["coefficients"], ["click", "#next"], ["work"], ["slide", "#turn", "30"], ["coefficients"]]
    steps += [
        ["drop", str(tmp_path / "small.hdr")],
        ["coefficients"],
        ["drop", str(tmp_path / "small.exr")],
        ["coefficients"],
        ["drop", str(tmp_path / "sun.hdr")],
        ["coefficients"],
    ]
    *found, averaged = (each for each in drive(run_node, site, steps, **BACKENDS["webgl"]) if each)
    small = [prt.read_environment(tmp_path / f"small.{kind}") for kind in ("hdr", "exr")]
    expected = [prt.project_environment(sky, 3, "y")]
    expected += [prt.rotate_light(prt.project_environment(each, 3, "z"), 30.0, "z") for each in (sky, *small)]
    for coefficients, right in zip(found, expected, strict=True):
        assert abs(np.reshape(coefficients, (-1, 3)) - right).max() < 1e-5 * abs(right).max()
    large = prt.rotate_light(prt.project_environment(prt.read_environment(tmp_path / "sun.hdr"), 3, "z"), 30.0, "z")
    assert abs(np.reshape(averaged, (-1, 3)) - large).max() < 2e-3 * abs(large).max()
