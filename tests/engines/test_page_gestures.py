"""The page of `prtbake export` in Chromium: mouse, fingers, keys, and screens that turn."""

import math
from pathlib import Path

import numpy as np
import pytest

from formats.asset import write_asset
from prt_bake.shipped.examples import example
from tests.engines.conftest import RunNode
from tests.engines.pages import make_site, states
from tests.export.assets import smooth_asset

pytestmark = pytest.mark.usefixtures("chromium")

LEFT, RIGHT = [250, 200], [350, 230]
PHONE = {"touch": True, "width": 390, "height": 844}


@pytest.fixture
def site(tmp_path: Path) -> Path:
    write_asset(smooth_asset(), tmp_path / "asset.h5")
    return make_site(tmp_path / "site", [tmp_path / "asset.h5"], [example("sky.hdr")])


def test_drag_orbits_and_with_shift_turns_the_light(run_node: RunNode, site: Path) -> None:
    first, orbit, shift, right, button, pressed = states(
        run_node,
        site,
        ["drag", LEFT, RIGHT],
        ["drag", LEFT, RIGHT, {"key": "Shift"}],
        ["drag", LEFT, RIGHT, {"button": "right"}],
        ["click", "#drag"],
        ["drag", RIGHT, LEFT],
    )
    assert orbit["eye"] != first["eye"]
    assert orbit["turn"] == 0.0
    assert shift["turn"] == pytest.approx(40.0, abs=1.0)
    assert np.allclose(shift["eye"], right["eye"], atol=1e-2)
    assert right["turn"] == pytest.approx(80.0, abs=2.0)
    assert pressed["turn"] == pytest.approx(40.0, abs=3.0)
    assert np.allclose(pressed["eye"], button["eye"], atol=1e-2)


def test_the_sun_is_dragged_in_both_directions(run_node: RunNode, site: Path) -> None:
    first, sun, dragged = states(run_node, site, ["click", "#next-light"], ["drag", LEFT, RIGHT, {"key": "Shift"}])
    assert (first["light"], sun["light"]) == ("sky.hdr", "sun")
    assert (first["heightShown"], sun["heightShown"]) == (False, True)
    assert dragged["turn"] == pytest.approx(40.0, abs=1.0)
    assert dragged["height"] == pytest.approx(31.0, abs=1.0)


def test_a_finger_orbits_a_phone(run_node: RunNode, site: Path) -> None:
    first, orbit = states(run_node, site, ["swipe", [150, 300], [250, 320]], **PHONE)
    assert orbit["eye"] != first["eye"]


def test_two_fingers_zoom_also_while_one_turns_the_light(run_node: RunNode, site: Path) -> None:
    drag = ["press", "#drag", 1]
    first, plain, _, pressed, swiped = states(
        run_node,
        site,
        ["pinch", [100, 250], [290, 350]],
        drag,
        ["pinch", [100, 250], [290, 350]],
        ["swipe", [150, 300], [250, 320]],
        **PHONE,
    )
    distances = [float(np.linalg.norm(state["eye"][:3])) for state in (first, plain, pressed)]
    assert distances[1] < 0.9 * distances[0]
    assert distances[2] < 0.9 * distances[1]
    assert (plain["turn"], pressed["turn"]) == (0.0, 0.0)
    assert swiped["turn"] != 0.0
    assert np.allclose(swiped["eye"], pressed["eye"], atol=1e-2)


@pytest.mark.parametrize("sizes", [[(390, 844), (844, 390)], [(844, 390), (390, 844)]])
def test_a_phone_that_is_turned_shows_the_whole_object(
    sizes: list[tuple[int, int]], run_node: RunNode, site: Path
) -> None:
    phone = PHONE | {"width": sizes[0][0], "height": sizes[0][1]}
    for state in states(run_node, site, ["resize", *sizes[1]], **phone):
        shorter = math.tan(math.radians(state["angle"]) / 2.0) * min(1.0, state["aspect"])
        assert shorter == pytest.approx(math.tan(math.radians(15.0)))
    assert state["aspect"] == pytest.approx(sizes[1][0] / sizes[1][1], rel=0.3)


def test_keys_orbit(run_node: RunNode, site: Path) -> None:
    first, orbit = states(run_node, site, ["shift", "#view", "ArrowRight", 5])
    assert orbit["eye"] != first["eye"]
    assert np.linalg.norm(orbit["eye"][:3]) == pytest.approx(np.linalg.norm(first["eye"][:3]), rel=1e-3)
