"""Lobes in frames and in compact assets: those of `shade`."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import prt_bake as prt
from formats.errors import QueryError
from prt_bake.lights.lighting import Lighting, Sky, read_lighting
from prt_bake.shading.frames.frames import Frames
from tests import ROOT
from tests.baking.lobes.transports import MESH, Lobed, along_normal


def everywhere(light):
    """The light whose suns are shaded by harmonics and lobes in the dark too, as frames do."""
    return replace(light, harmonics=light.whole, suns=())


def test_lobes_are_those_of_shade() -> None:
    sky = np.random.default_rng(3).gamma(0.3, size=(32, 64, 3)).astype(np.float32)
    lighting = Lighting((Sky(sky, "y", np.eye(3)),), read_lighting("sun:0.3,1,0.2:2,2,2:0.5").suns)
    eye = np.array([0.5, 2.0, -2.5])
    for rings, sectors in ((8, 16), (1, 1)):
        asset = prt.bake(Lobed(((along_normal, 12.0, 1.0),)), MESH, rings=rings, sectors=sectors, lobes=4)
        light = prt.light_for(asset, lighting)
        frames = Frames(asset)
        frames.light(light)
        expected = prt.shade(asset, everywhere(light), eye)
        np.testing.assert_allclose(frames.draw(eye), expected, rtol=1e-4, atol=1e-5)
        frames.hold(eye)
        np.testing.assert_allclose(frames.draw(eye), expected, rtol=1e-4, atol=1e-5)
        frames.fold()
        np.testing.assert_allclose(frames.draw(-eye), prt.shade(asset, everywhere(light), -eye), rtol=1e-4, atol=1e-5)
        frames.turn(70.0)
        turned = prt.shade(asset, everywhere(prt.light_for(asset, lighting.turned(70.0, "y"))), eye)
        np.testing.assert_allclose(frames.draw(eye), turned, atol=0.01 * turned.max())
        frames.light(light.whole)
        np.testing.assert_allclose(frames.draw(eye), prt.shade(asset, light.whole, eye), rtol=1e-4, atol=1e-5)


def test_a_light_of_lobes_needs_an_asset_with_lobes() -> None:
    lighting = read_lighting("sun:0.3,1,0.2:2,2,2:0.5")
    plain, lobed = (prt.bake(Lobed(), MESH, rings=4, sectors=8, samples=18, lobes=lobes) for lobes in (0, 4))
    light = prt.light_for(lobed, lighting)
    with pytest.raises(QueryError, match="prepared for an asset with lobes"):
        prt.shade(plain, light, [0.5, 2.0, -2.5])
    with pytest.raises(QueryError, match="prepared for an asset with lobes"):
        Frames(plain).light(light)
    with pytest.raises(QueryError, match="prepared for an asset without lobes"):
        Frames(lobed).light(prt.light_for(plain, lighting))
    Frames(lobed).light(prt.light_for(plain, lighting, "plain"))


def test_a_light_is_for_lobes_of_its_sharpness() -> None:
    asset = prt.bake(Lobed(), MESH, rings=4, sectors=8, samples=18, lobes=4)
    assert asset.lobes is not None
    light = prt.light_for(asset, read_lighting(ROOT / "prt_bake" / "shipped" / "sky.hdr"))
    for factor in (0.4, 16.0):
        sharper = replace(asset, lobes=replace(asset.lobes, sharpness=factor * asset.lobes.sharpness))
        with pytest.raises(
            QueryError, match=r"prepared for an asset with other lobes; prt.light_for\(asset, lighting\)"
        ):
            prt.shade(sharper, light, [0.5, 2.0, -2.5])
        with pytest.raises(QueryError, match="prepared for an asset with other lobes"):
            Frames(sharper).light(light)
    Frames(replace(asset, lobes=replace(asset.lobes, sharpness=1.2 * asset.lobes.sharpness))).light(light)


def test_compact_assets_keep_their_lobes(tmp_path: Path) -> None:
    prt.bake(Lobed(), MESH, rings=4, sectors=16, lobes=4, out=tmp_path / "plain.h5").close()
    compact = prt.compress(prt.read_asset(tmp_path / "plain.h5"), 0.01)
    prt.write_asset(compact, tmp_path / "compact.h5")
    eye, lighting = np.array([0.5, 2.0, -2.5]), read_lighting("sun:0.3,1,0.2:2,2,2:0.5")
    for asset in (compact, prt.read_asset(tmp_path / "compact.h5"), prt.unpacked(compact)):
        light = prt.light_for(asset, lighting)
        assert light.lobes is not None
        frames = Frames(asset)
        frames.light(light)
        np.testing.assert_allclose(frames.draw(eye), prt.shade(asset, everywhere(light), eye), rtol=1e-3, atol=1e-4)
