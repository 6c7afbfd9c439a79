"""Suns on the command line: `light` lists them, `shade` reports their treatment."""

import json
from pathlib import Path

import numpy as np
import pytest

from formats.image import write_image
from formats.scene.lights import parse_sun
from tests.conftest import Run
from tests.lights.test_suns import SUNNY


def test_light_prints_suns_as_other_commands_take_them(prtbake: Run, tmp_path: Path) -> None:
    write_image(tmp_path / "sunny.exr", SUNNY)
    suns = json.loads(prtbake("light", tmp_path / "sunny.exr", "--json", "--rotate", "90").out)["suns"]
    assert [sun["share"] > 0.02 for sun in suns] == [True, True]
    table = prtbake("light", tmp_path / "sunny.exr", "--rotate", "90").out.splitlines()
    assert len(table) == 12
    for sun, line in zip(suns, table[10:], strict=True):
        light = parse_sun(line.split()[0])
        np.testing.assert_allclose(light.direction, sun["direction"], atol=1e-5)
        np.testing.assert_allclose(light.irradiance, sun["irradiance"], rtol=1e-5)
        assert light.angular_diameter == pytest.approx(sun["angular_diameter"], rel=1e-3)
    assert json.loads(prtbake("light", "sky.exr", "--json").out)["suns"] == []


def test_light_takes_lights_without_a_sky_and_lists_the_suns_of_every_sky(prtbake: Run, tmp_path: Path) -> None:
    write_image(tmp_path / "sunny.exr", SUNNY)
    lamp = "[[directional]]\ndirection = [0, 1, 0]\nirradiance = [1, 2, 3]\n"
    (tmp_path / "lamp.toml").write_text(lamp)
    calm, sunny = '[[sky]]\nfile = "calm.exr"\n', '[[sky]]\nfile = "sunny.exr"\n'
    write_image(tmp_path / "calm.exr", np.ones((8, 16, 3)))
    (tmp_path / "skies.toml").write_text(calm + sunny + lamp)
    alone = {}
    for light in ("sun:0,1,0:1,2,3", tmp_path / "lamp.toml", tmp_path / "calm.exr", tmp_path / "sunny.exr"):
        outcome = prtbake("light", light, "--json")
        assert (outcome.code, outcome.err) == (0, "")
        alone[str(light)] = json.loads(outcome.out)
    directional, lamp_light, calm_light, sunny_light = alone.values()
    assert directional["suns"] == lamp_light["suns"] == []
    assert directional["coefficients"] == lamp_light["coefficients"]
    together = json.loads(prtbake("light", tmp_path / "skies.toml", "--json").out)
    assert together["suns"] == sunny_light["suns"] != []
    parts = sum(np.array(light["coefficients"]) for light in (lamp_light, calm_light, sunny_light))
    np.testing.assert_allclose(together["coefficients"], parts, rtol=1e-9, atol=1e-9)
    assert "of the energy of its sky" in prtbake("light", tmp_path / "skies.toml").out


@pytest.mark.parametrize(
    ("treatment", "message"), [("split", "1 sun split off"), ("window", "1 sun damped by a window"), ("plain", None)]
)
def test_shade_reports_its_treatment_of_suns(prtbake: Run, tmp_path: Path, treatment: str, message: str | None) -> None:
    lights = ["--light", "sky.exr", "--light", "sun:1,1,-1:3,3,3:0.53"]
    done = prtbake("shade", "asset.h5", *lights, "-o", tmp_path / "a.exr", "--size", "16x12", "--suns", treatment)
    assert done.code == 0, done.err
    assert (message in done.out) if message else (" sun " not in done.out)
    assert ("suns unknown)" in done.out) == (treatment != "split")
    calm = prtbake("shade", "asset.h5", "--light", "sky.exr", "-o", tmp_path / "b.exr", "--size", "16x12")
    assert " sun" not in calm.out


def test_a_sun_without_a_sky_is_split_from_nothing(prtbake: Run, tmp_path: Path) -> None:
    done = prtbake("shade", "asset.h5", "--light", "sun:0,1,0", "-o", tmp_path / "a.exr", "--size", "16x12")
    assert ", 1 sun" in done.out
    assert "split" not in done.out


def test_an_unknown_treatment_of_suns_is_wrong_usage(prtbake: Run) -> None:
    assert prtbake("shade", "asset.h5", "--light", "sky.exr", "-o", "x.exr", "--suns", "none").code == 2
