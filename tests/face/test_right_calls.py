"""Numbers and arrays of other kinds that are as good as NumPy's own give the same result."""

import dataclasses
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

import prt_bake as prt
from tests import ROOT
from tests.shading.test_picture import make_asset
from tests.shapes import ball

ASSET = make_asset(ball(2))
LIGHT, SKY, EYE = np.ones((9, 3)), np.ones((8, 16, 3), np.float32), [0.0, 0.0, 9.0]
SUNS = prt.read_lighting("sun:0,1,0").suns


class Frame:
    """A table of another library, which NumPy reads."""

    def __init__(self, values: Any) -> None:
        self.values = np.asarray(values)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Any:
        return self.values


LIGHTS: dict[str, Any] = {
    "list": LIGHT.tolist(),
    "half": LIGHT.astype(np.float16),
    "bfloat16": torch.ones(9, 3, dtype=torch.bfloat16),
    "big-endian": LIGHT.astype(">f8"),
    "columns": np.asfortranarray(LIGHT),
    "strided": np.ones((18, 6))[::2, ::2],
    "read-only": np.broadcast_to(1.0, (9, 3)),
    "table": Frame(LIGHT),
    "integers": np.ones((9, 3), np.int8),
    "nothing masked": np.ma.masked_array(LIGHT, LIGHT < 0.0),
}


@pytest.mark.parametrize("name", LIGHTS)
def test_lights_of_other_kinds_are_taken(name: str) -> None:
    np.testing.assert_allclose(prt.shade(ASSET, LIGHTS[name], EYE), prt.shade(ASSET, LIGHT, EYE), rtol=1e-6)
    turned = prt.rotate_light(LIGHTS[name], np.float32(30.0))
    np.testing.assert_allclose(turned, prt.rotate_light(LIGHT, 30.0), atol=1e-6)


def test_one_sun_a_list_and_a_generator_are_alike() -> None:
    expected = prt.shade(ASSET, LIGHT, EYE, suns=SUNS)
    assert not np.allclose(expected, prt.shade(ASSET, LIGHT, EYE))
    for suns in (SUNS[0], list(SUNS), (sun for sun in SUNS)):
        np.testing.assert_array_equal(prt.shade(ASSET, LIGHT, EYE, suns=suns), expected)


def test_masks_of_8_bits_are_halved_at_128() -> None:
    image, part = SKY.copy(), np.zeros((8, 16), bool)
    image[:, :4], part[:, :8] = 2.0, True
    expected = prt.compare(image, SKY, part).mse
    assert expected == pytest.approx(0.5)
    for mask in (np.where(part, 255, 100).astype(np.uint8), torch.tensor(part), part.tolist(), np.where(part, 1, 0)):
        assert prt.compare(image, SKY, mask).mse == expected


def test_what_a_docstring_offers_is_taken() -> None:
    assert prt.compare(SKY, 0.5 * SKY, hdr=(-1.0, 1.0)).hdr_exposures is not None
    textured = dataclasses.replace(ASSET.mesh, uv=np.full((len(ASSET.mesh.positions), 2), 0.5))
    asset = dataclasses.replace(ASSET, mesh=textured, provenance={"eta": 1.5, "roughness": 0.3})
    camera = prt.fit_camera(textured, 6, 6)
    texture, number = (
        prt.render_picture(asset, SKY, camera, reflection=True, roughness=alpha).image
        for alpha in (np.full((2, 2), 0.2), 0.2)
    )
    np.testing.assert_allclose(texture, number, rtol=1e-5)
    scene = prt.load_scene(ROOT / "prt_bake" / "shipped" / "spot.toml")
    picture = prt.render_scene(scene, SKY, prt.fit_camera(scene.mesh, 2, 2), spp=None, minutes=0.0)
    assert picture.passes == 2


def test_a_copy_shades_alike() -> None:
    copied: prt.Asset = pickle.loads(pickle.dumps(ASSET))
    np.testing.assert_array_equal(prt.shade(copied, LIGHT, EYE), prt.shade(ASSET, LIGHT, EYE))


MISSPELT: dict[str, Callable[[], Any]] = {
    "width": lambda: prt.fit_camera(ASSET.mesh, widht=3),  # type: ignore[call-arg]
    "reflection": lambda: prt.render_picture(ASSET, SKY, EYE, reflections=True),  # type: ignore[call-arg]
}


@pytest.mark.parametrize("name", MISSPELT)
def test_a_misspelt_keyword_is_answered_with_the_right_one(name: str) -> None:
    with pytest.raises(TypeError, match=f"unexpected keyword argument '.*'; did you mean '{name}'"):
        MISSPELT[name]()
