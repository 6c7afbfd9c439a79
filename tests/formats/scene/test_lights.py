"""Lights files and lights in one word: their values, and the messages for invalid ones."""

import codecs

import numpy as np
import pytest

from formats.errors import LightError, StorageError
from formats.scene.lights import DirectionalLight, SkyLight, parse_sun, parse_word, read_lights


def test_a_file_with_every_kind_of_light_is_read(tmp_path):
    (tmp_path / "a.toml").write_text(
        "[[directional]]\ndirection = [0, 3, 4]\nirradiance = [3, 2.5, 2]\nangular_diameter = 0.53\n"
        "[[directional]]\ndirection = [-1e-200, 0, 0]\n"
        '[[sky]]\nfile = "night.hdr"\nrotate = 90\nexposure = -2\ntint = [1, 0.5, 0]\n[[sky]]\nfile = "day.exr"\n'
    )
    sun, second, night, day = read_lights(tmp_path / "a.toml")
    assert isinstance(sun, DirectionalLight)
    assert isinstance(second, DirectionalLight)
    np.testing.assert_allclose(sun.direction, [0, 0.6, 0.8], rtol=1e-15)
    assert (sun.irradiance.tolist(), sun.angular_diameter) == ([3, 2.5, 2], 0.53)
    assert (second.direction.tolist(), second.irradiance.tolist(), second.angular_diameter) == ([-1, 0, 0], [1] * 3, 0)
    assert night == SkyLight(tmp_path / "night.hdr", 90.0, -2.0, (1.0, 0.5, 0.0))
    assert day == SkyLight(tmp_path / "day.exr", 0.0, 0.0, (1.0, 1.0, 1.0))


@pytest.mark.parametrize(
    ("text", "irradiance", "diameter"),
    [
        ("sun:0,0,2", [1, 1, 1], 0),
        ("sun:0,0,2:3,2,1", [3, 2, 1], 0),
        ("sun:0,0,2:0.5", [1, 1, 1], 0.5),
        ("sun:0,0,2:3,2,1:0.5", [3, 2, 1], 0.5),
    ],
)
def test_a_sun_in_one_word_is_parsed(text, irradiance, diameter):
    sun = parse_sun(text)
    assert (sun.direction.tolist(), sun.irradiance.tolist(), sun.angular_diameter) == ([0, 0, 1], irradiance, diameter)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("sun:", "expected sun:x,y,z"),
        ("sun:1,2", "expected sun:x,y,z"),
        ("sun:1,2,x", "expected sun:x,y,z"),
        ("sun:1,2,3:1:2", "expected sun:x,y,z"),
        ("sun:1,2,3:1,1,1:2:3", "expected sun:x,y,z"),
        ("sun:0,0,0", "direction: expected three"),
        ("sun:0,inf,0", "direction: expected three"),
        ("sun:nan,0,1", "direction: expected three"),
        ("sun:0,1,0:1,-1,1", "irradiance: expected three"),
        ("sun:0,1,0:1,nan,1", "irradiance: expected three"),
        ("sun:0,1,0:1,1,1e31", "irradiance: expected three .* to 1e30"),
        ("sun:0,1,0:-0.5", "angular diameter: expected degrees"),
        ("sun:0,1,0:181", "angular diameter: expected degrees"),
    ],
)
def test_an_invalid_sun_is_refused_in_one_sentence(text, sentence):
    with pytest.raises(LightError, match=sentence) as caught:
        parse_sun(text)
    assert text in str(caught.value)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "has no light"),
        ("sun = 3", "sun: unknown key"),
        ("[directional]\ndirection = [0, 1, 0]", r"directional: expected tables \[\[directional\]\]"),
        ("[[directional]]\ndirection = [0, 1, 0]\nsize = 1", "directional.0.size: unknown key; expected direction"),
        ("[[directional]]\ndirektion = [0, 1, 0]", "did you mean 'direction'"),
        ("[[directional]]\nirradiance = [1, 1, 1]", "directional.0.direction: is missing"),
        ("[[directional]]\ndirection = [0, 0, 0]", "directional.0: direction: expected three"),
        ("[[directional]]\ndirection = [0, 1]", "directional.0.direction: expected three"),
        ("[[directional]]\ndirection = [0, nan, 1]", "directional.0.direction: expected three"),
        ("[[directional]]\ndirection = [0, 1, 0]\nirradiance = [1, -1, 1]", "irradiance: expected three"),
        ("[[directional]]\ndirection = [0, 1, 0]\nirradiance = 3.0", "irradiance: expected three"),
        ("[[directional]]\ndirection = [0, 1, 0]\nangular_diameter = -1", "expected degrees from 0 to 180, found -1"),
        ('[[sky]]\nfile = "a.hdr"\ntint = [1, -1, 1]', "sky.0.tint: expected three numbers"),
        ('[[sky]]\nfile = "a.hdr"\nexposure = "much"', "sky.0.exposure: expected stops from -64 to 64, found 'much'"),
        ("[[sky]]\nrotate = 3", "sky.0.file: is missing"),
        ("no toml", "is not TOML"),
        pytest.param("x = " + 5000 * "[", "is not TOML", id="deep"),
        pytest.param("x = " + 5000 * "9", "is not TOML", id="long"),
        ("[[directional]]\ndirection = [0, 1, 0]\nirradiance = [1, 1e31, 1]", "irradiance: expected three .* to 1e30"),
    ],
)
def test_an_invalid_lights_file_is_refused_in_one_sentence(tmp_path, text, sentence):
    path = tmp_path / "a.toml"
    path.write_text(text)
    with pytest.raises(LightError, match=sentence) as caught:
        read_lights(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_binary_and_missing_files_are_refused(tmp_path):
    (tmp_path / "a.toml").write_bytes(b"\x89PNG\xff")
    with pytest.raises(LightError, match="expected UTF-8 text"):
        read_lights(tmp_path / "a.toml")
    with pytest.raises(StorageError, match="no such file"):
        read_lights(tmp_path / "b.toml")


def test_a_byte_order_mark_changes_nothing_and_other_encodings_are_named(tmp_path):
    text = "[[directional]]\ndirection = [0, 0, 1]\nirradiance = [1, 2, 3]\n"
    (tmp_path / "a.toml").write_bytes(codecs.BOM_UTF8 + text.encode())
    assert read_lights(tmp_path / "a.toml")[0].irradiance.tolist() == [1, 2, 3]
    (tmp_path / "a.toml").write_bytes(text.encode("utf-16"))
    with pytest.raises(LightError, match=r"a\.toml: expected text in UTF-8, found UTF-16"):
        read_lights(tmp_path / "a.toml")


def test_a_word_that_names_a_file_is_no_light():
    assert parse_word("sky.exr") is None
    assert isinstance(parse_word("sun:0,1,0"), DirectionalLight)
