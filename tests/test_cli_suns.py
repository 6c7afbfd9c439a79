"""The commands that know of suns: `light` names them, `shade` says what it did with them."""

import json
from pathlib import Path

import numpy as np
import pytest
from conftest import Run
from test_suns import SUNNY

from formats.image import write_image
from formats.lights import parse_sun


def test_light_names_suns_as_other_commands_take_them(prtbake: Run, tmp_path: Path) -> None:
    write_image(tmp_path / "sunny.exr", SUNNY)
    told = json.loads(prtbake("light", tmp_path / "sunny.exr", "--json", "--rotate", "90").out)["suns"]
    assert [sun["share"] > 0.02 for sun in told] == [True, True]
    table = prtbake("light", tmp_path / "sunny.exr", "--rotate", "90").out.splitlines()
    assert len(table) == 12
    for sun, line in zip(told, table[10:], strict=True):
        light = parse_sun(line.split()[0])
        np.testing.assert_allclose(light.direction, sun["direction"], atol=1e-5)
        np.testing.assert_allclose(light.irradiance, sun["irradiance"], rtol=1e-5)
        assert light.angular_diameter == pytest.approx(sun["angular_diameter"], rel=1e-3)
    assert json.loads(prtbake("light", "sky.exr", "--json").out)["suns"] == []


def test_light_takes_a_light_without_a_sky_and_one_of_two_skies(prtbake: Run, tmp_path: Path) -> None:
    write_image(tmp_path / "sunny.exr", SUNNY)
    once = prtbake("light", tmp_path / "sunny.exr").out.splitlines()[10:]
    (tmp_path / "two.toml").write_text(2 * '[[sky]]\nfile = "sunny.exr"\n')
    assert prtbake("light", tmp_path / "two.toml").out.splitlines()[10:] == 2 * once
    sun = prtbake("light", "sun:0,1,0:2,2,2")
    assert (sun.code, len(sun.out.splitlines())) == (0, 10)
    assert float(sun.out.splitlines()[1].split()[2]) == pytest.approx(2 * 0.5 / np.sqrt(np.pi), rel=1e-6)


@pytest.mark.parametrize(
    ("treatment", "said"), [("split", "1 sun split"), ("window", "1 sun damped by a window"), ("plain", None)]
)
def test_shade_says_what_it_did_with_suns(prtbake: Run, tmp_path: Path, treatment: str, said: str | None) -> None:
    lights = ["--light", "sky.exr", "--light", "sun:1,1,-1:3,3,3:0.53"]
    done = prtbake("shade", "asset.h5", *lights, "-o", tmp_path / "a.exr", "--size", "16x12", "--suns", treatment)
    assert done.code == 0, done.err
    assert (said in done.out) if said else (" sun" not in done.out)
    calm = prtbake("shade", "asset.h5", "--light", "sky.exr", "-o", tmp_path / "b.exr", "--size", "16x12")
    assert " sun" not in calm.out


def test_another_treatment_is_wrong_usage(prtbake: Run) -> None:
    assert prtbake("shade", "asset.h5", "--light", "sky.exr", "-o", "x.exr", "--suns", "none").code == 2
