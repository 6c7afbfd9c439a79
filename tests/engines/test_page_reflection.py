"""The light that the page reflects at the surface is that of `prt.render_picture`."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import prt_bake as prt
from formats.asset import Asset, read_asset, write_asset
from prt_bake.export.gltf import export_gltf
from prt_bake.shipped.examples import example
from tests.engines.conftest import RunNode
from tests.engines.pages import BACKENDS, camera_of, drive, make_site
from tests.engines.pictures import soft_asset
from tests.export.assets import ball, smooth_asset

pytestmark = pytest.mark.usefixtures("chromium")

TURN = 30.0
WIDTH, HEIGHT, SAMPLES = 120, 90, 3


def with_surface(asset: Asset, eta: float, roughness: float) -> Asset:
    return dataclasses.replace(asset, provenance=dict(asset.provenance) | {"eta": eta, "roughness": roughness})


def sun_of(up: str) -> str:
    """The page's own sun, at the height that it has first."""
    level, above = np.cos(np.radians(40.0)), np.sin(np.radians(40.0))
    x, y, z = [0.0, above, level] if up == "y" else [0.0, -level, above]
    return f"sun:{x},{y},{z}:{np.pi},{np.pi},{np.pi}"


def pictures_of_page(run_node: RunNode, path: Path, asset: Asset, light: str, **job: Any) -> list[np.ndarray]:
    """Pictures [H,W,3] by the page without and with the button "Reflection", under a turned light."""
    camera = camera_of(prt.fit_camera(asset.mesh, WIDTH, HEIGHT, up=asset.up), SAMPLES)
    choose: list[Any] = [["click", "#next-light"]] if light == "sun" else []
    steps = [["ready"], *choose, ["slide", "#turn", TURN], ["picture", camera], ["click", "#reflection"]]
    site = make_site(path.parent / "site", [path], [example("sky.hdr")])
    found = [each for each in drive(run_node, site, [*steps, ["picture", camera]], **job) if each]
    return [np.reshape(each, (HEIGHT, SAMPLES, WIDTH, SAMPLES, 4)).mean(axis=(1, 3))[..., :3] for each in found]


def pictures(asset: Asset, light: str) -> tuple[list[np.ndarray], np.ndarray]:
    """The same by `prt.render_picture`, and where the object covers whole pixels [H,W]."""
    camera = prt.fit_camera(asset.mesh, WIDTH, HEIGHT, up=asset.up)
    source = sun_of(asset.up) if light == "sun" else str(example("sky.hdr"))
    lighting = prt.read_lighting(source, up=asset.up, rotate=TURN)
    with_and_without = [
        prt.render_picture(asset, lighting, camera, samples=4, background=False, suns="plain", reflection=reflection)
        for reflection in (False, True)
    ]
    return [each.image for each in with_and_without], with_and_without[0].coverage == 1


@pytest.mark.parametrize(
    ("kind", "up", "roughness", "light", "backend", "error"),
    [
        # The product of two means is not exact for a rough surface, nor in the window (`prt_bake.preview.mirrored`).
        ("h5", "y", 0.2, "sky", "webgl", 0.12),
        ("glb", "z", 0.2, "sky", "webgpu", 0.12),
        ("h5", "z", 0.0, "sky", "webgl", 0.03),
        ("glb", "y", 0.2, "sun", "webgl", 0.01),
    ],
)
def test_reflection_of_a_convex_object(
    kind: str, up: str, roughness: float, light: str, backend: str, error: float, run_node: RunNode, tmp_path: Path
) -> None:
    path = tmp_path / f"asset.{kind}"
    asset = with_surface(smooth_asset(ball(4), up=up), 1.4, roughness)
    write_asset(asset, path) if kind == "h5" else export_gltf(asset, path, 3)
    plain, added = pictures_of_page(run_node, path, asset, light, **BACKENDS[backend])
    (right_plain, right_added), covered = pictures(asset, light)
    found, right = (added - plain)[covered], (right_added - right_plain)[covered]
    difference = np.sqrt(np.square(found - right).sum() / np.square(right).sum())
    print(f"{kind} {up} {roughness} {light} {backend}: {difference:.4f} of the reflected light")
    assert difference < error
    assert found.mean() == pytest.approx(right.mean(), rel=0.06)


def test_reflection_of_spot(run_node: RunNode, tmp_path: Path) -> None:
    """The page lacks the object in its own reflection; the error is that of the picture."""
    asset = with_surface(soft_asset(), 1.4, 0.2)
    write_asset(asset, tmp_path / "spot.h5")
    asset = read_asset(tmp_path / "spot.h5")
    _, added = pictures_of_page(run_node, tmp_path / "spot.h5", asset, "sky", **BACKENDS["webgl"])
    (_, right), covered = pictures(asset, "sky")
    difference = np.sqrt(np.square(added - right)[covered].sum() / np.square(right[covered]).sum())
    print(f"spot: {difference:.4f} of the picture")
    assert difference < 0.08


def test_the_button_is_there_for_surfaces_that_reflect(run_node: RunNode, tmp_path: Path) -> None:
    """Not for an index of 1, nor for an object of one light."""
    shown: list[Any] = [["ready"], ["visible", "#reflection"], ["state"]]
    for name, eta, light in (("mirrors", 1.4, None), ("same_index", 1.0, None), ("one_light", 1.4, np.ones((9, 3)))):
        asset = with_surface(smooth_asset(), eta, 0.2)
        export_gltf(asset, tmp_path / f"{name}.glb", 3, light=light, light_name="a light")
        _, visible, state = drive(run_node, make_site(tmp_path / name, [tmp_path / f"{name}.glb"]), shown)
        assert visible is (name == "mirrors")
        assert ("the object in its own reflection" in state["leftOut"]) is (name == "mirrors")
        assert ("light reflected at the surface" in state["leftOut"]) is (name == "one_light")
