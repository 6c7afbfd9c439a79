"""A path in place of an object raises an error that names the function to read it with."""

from collections.abc import Callable

import numpy as np
import pytest

import prt_bake as prt
from formats.errors import QueryError
from tests.bakers.transports import Lobed
from tests.shading.test_picture import constant, front, make_asset
from tests.shapes import ball

ASSET = make_asset(ball(2))
LIGHT = np.zeros((9, 3))


@pytest.mark.parametrize(
    ("call", "name", "reader"),
    [
        (lambda: prt.shade("spot.h5", LIGHT, [0, 0, 9]), "asset", "read_asset"),
        (lambda: prt.render_picture("spot.h5", constant(), front()), "asset", "read_asset"),
        (lambda: prt.render_picture(ASSET, "sky.hdr", front()), "light", "read_lighting"),
        (lambda: prt.Frames("spot.h5"), "asset", "read_asset"),
        (lambda: prt.compress("spot.h5", 0.01), "asset", "read_asset"),
        (lambda: prt.suns_apart("sky.hdr", 2), "lighting", "read_lighting"),
        (lambda: prt.compare("a.exr", constant()), "image", "read_image"),
        (lambda: prt.compare(constant(), "b.exr"), "reference", "read_image"),
        (lambda: prt.bake("spot.pt", ASSET.mesh), "transport", "load_model"),
        (lambda: prt.bake(Lobed(), "spot.obj"), "mesh", "read_mesh"),
        (lambda: prt.render_scene("spot.toml", constant(), front()), "scene", "load_scene"),
        (lambda: prt.train("spot.toml"), "scene", "load_scene"),
    ],
)
def test_a_path_is_refused_with_the_name_of_its_reader(call: Callable[[], object], name: str, reader: str) -> None:
    with pytest.raises(QueryError, match=rf"{name}.*: expected what prt\.{reader}\(path\) returns, found the path .*"):
        call()
    assert reader in prt.__all__


def test_a_method_is_refused_in_place_of_suns() -> None:
    with pytest.raises(QueryError, match=r"suns: expected directional lights.*suns_apart.*found 'split'"):
        prt.shade(ASSET, LIGHT, [0, 0, 9], suns="split")


def test_a_single_light_equals_a_list_of_one() -> None:
    single, listed = prt.read_lighting("sun:0,1,0"), prt.read_lighting(["sun:0,1,0"])
    np.testing.assert_array_equal(single.suns[0].direction, listed.suns[0].direction)
