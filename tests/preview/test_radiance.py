"""Radiance by NumPy and by the compiled kernels, and the libraries that the first picture loads."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import prt_bake as prt
from formats.asset import read_asset, write_asset
from formats.image import write_image
from prt_bake.baking.compress import compress
from prt_bake.lights import environment
from prt_bake.preview.radiance import VertexRadiance
from prt_bake.shading.frames.frames import Frames
from tests.baking.lobes.transports import MESH, Lobed
from tests.shading import reference
from tests.shading.test_frame_lobes import everywhere
from tests.shading.test_picture import make_asset, make_light
from tests.shapes import ball

EYE = np.array([0.3, 1.2, 3.5])
VALID = np.arange(66) % 5 != 2


@pytest.mark.parametrize("storage", ["float32", "float16"])
@pytest.mark.parametrize(("rings", "sectors", "degree"), [(16, 64, 2), (4, 6, 3), (1, 1, 2), (1, 5, 1), (3, 1, 0)])
@pytest.mark.parametrize(("views", "channels"), [(None, 3), (1, 3), (None, 1), (1, 1)])
def test_numpy_equals_the_slow_reference(storage, rings, sectors, degree, views, channels) -> None:
    asset = make_asset(ball(2), rings, sectors, degree, 0, storage, views, channels, VALID)
    numpy = VertexRadiance(asset)
    light = make_light(degree)
    numpy.set_light(light, 70.0)
    assert not numpy.loaded
    turned = environment.rotate_light(light, 70.0, asset.up)
    for eye in (EYE, 5.0 * asset.mesh.normals[0], -EYE):
        expected = np.maximum(reference.reconstruct(asset, turned, eye), 0.0)
        np.testing.assert_allclose(numpy.draw(eye), expected, rtol=1e-5, atol=1e-6)


def test_kernels_equal_numpy_under_the_current_light() -> None:
    asset = make_asset(ball(2), valid=VALID)
    numpy, kernels = VertexRadiance(asset), VertexRadiance(asset)
    kernels.set_light(make_light(seed=1), 0.0)
    kernels.load()
    assert kernels.loaded
    for seed, degrees in ((1, 0.0), (2, 30.0), (2, -60.0)):
        for each in (numpy, kernels):
            each.set_light(make_light(seed=seed), degrees)
        np.testing.assert_allclose(kernels.draw(EYE), numpy.draw(EYE), rtol=1e-5, atol=1e-6)


def test_a_moving_light_and_a_resting_eye_interpolate_once(monkeypatch) -> None:
    asset, held = make_asset(ball(2), valid=VALID), []
    kernels, numpy = VertexRadiance(asset), VertexRadiance(asset)
    kernels.load()
    hold = Frames.hold
    monkeypatch.setattr(Frames, "hold", lambda self, eye: (held.append(tuple(eye)), hold(self, eye)))
    for eye in (EYE, EYE, EYE, EYE, -EYE, EYE, -EYE, -EYE):
        for each in (kernels, numpy):
            each.set_light(make_light(), 10.0 * len(held) + eye[0])
        np.testing.assert_allclose(kernels.draw(eye), numpy.draw(eye), rtol=1e-5, atol=1e-6)
    assert held == [tuple(EYE), tuple(-EYE)]
    kernels.draw(EYE)
    kernels.draw(EYE)  # nothing moves
    assert len(held) == 2


def test_assets_for_one_light_and_compact_assets_are_drawn() -> None:
    fixed = make_asset(ball(2), degree=0, quantity="radiance")
    np.testing.assert_allclose(
        VertexRadiance(fixed).draw(EYE), reference.reconstruct(fixed, np.ones((1, 3)), EYE), rtol=1e-5
    )
    asset = make_asset(ball(2))
    compact = VertexRadiance(compress(asset, 1e-3))
    compact.set_light(make_light(), 10.0)
    plain = VertexRadiance(asset)
    plain.set_light(make_light(), 10.0)
    np.testing.assert_allclose(compact.draw(EYE), plain.draw(EYE), atol=0.02)


FIRST_PICTURES = """
import sys
from prt_bake.cli.main import main
for sky in sys.argv[1:]:
    assert main(["view", "asset.h5", "--light", sky, "--screenshot", "shot.png"]) == 0
    print("loaded", *sorted({name.partition(".")[0] for name in sys.modules}))
"""


def test_the_first_picture_loads_only_the_libraries_it_needs(folder: Path, tmp_path: Path) -> None:
    sky = np.ones((64, 128, 3), np.float32)
    write_image(tmp_path / "cloudy.exr", sky)
    sky[20, 70] += 1000.0
    write_image(tmp_path / "sunny.exr", sky)
    write_asset(replace(read_asset(folder / "asset.h5"), lobes=None), tmp_path / "asset.h5")
    command = [sys.executable, "-c", FIRST_PICTURES, "cloudy.exr", "sunny.exr"]
    ran = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    cloudy, sunny = (set(line.split()) for line in ran.stdout.splitlines() if line.startswith("loaded"))
    assert "pyvista" in cloudy
    assert not sunny & {"torch", "trimesh"}
    assert ("numba" in cloudy, "numba" in sunny) == (False, True)


def test_lobes_are_drawn_once_kernels_are_loaded() -> None:
    asset = prt.bake(Lobed(), MESH, rings=4, sectors=16, lobes=4)
    lighting, radiance = prt.read_lighting("sun:0.3,1,0.2:2,2,2:0.5"), VertexRadiance(asset)
    radiance.set_light(prt.light_for(asset, lighting), 40.0)
    assert radiance.lacks_lobes
    without = np.array(radiance.draw(EYE))
    radiance.load()
    assert not radiance.lacks_lobes
    light = prt.light_for(asset, lighting.turned(40.0, "y"))
    expected = prt.shade(asset, everywhere(light), EYE)
    np.testing.assert_allclose(radiance.draw(EYE), expected, rtol=1e-4, atol=1e-5)
    assert np.abs(without - expected).max() > 0.1 * expected.max()


def test_loading_kernels_is_silent_about_the_eye_of_an_asset() -> None:
    asset = replace(make_asset(ball(2)), provenance={"settings": {"for_eye": EYE.tolist()}})
    radiance = VertexRadiance(asset)
    radiance.load()
    radiance.draw(EYE)
    with pytest.warns(prt.InputWarning, match="made for the eye"):
        radiance.draw(-EYE)
