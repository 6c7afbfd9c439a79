"""Pictures of a training report: their light, their figures compared with independent pictures, and the criterion."""

import base64
import io
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from formats.errors import QueryError
from prt_bake.geometry import camera
from prt_bake.lights.environment import project
from prt_bake.rendering.scene import render_scene
from prt_bake.trainer.report import picture as training_picture
from prt_bake.trainer.report.picture import (
    ENLARGED,
    FLIP,
    SIZE,
    SUNS,
    picture_criterion,
    picture_error,
    picture_summary,
    sun_and_sky,
)
from tests.tracer.scenes import make_scene, sphere
from tests.trainer.report.test_assessment import Network


def fluence(image):
    """The sky's radiance over the whole sphere [3]."""
    return np.sqrt(4.0 * np.pi) * project(image, 0)[0]


@pytest.mark.parametrize(("sun", "eye_cosine"), [("aside", (0.0, 0.5)), ("behind", (-0.95, -0.7))])
@pytest.mark.parametrize("up", ["y", "z"])
def test_two_thirds_of_the_light_come_from_a_sun_above_the_horizon(tmp_path, up, sun, eye_cosine):
    light = sun_and_sky(replace(make_scene(tmp_path, sphere(1)), up=up), sun)
    (sky,), (disc,) = light.skies, light.suns
    sky_fluence = fluence(sky.image).mean()
    assert disc.irradiance.mean() / (disc.irradiance.mean() + sky_fluence) == pytest.approx(2.0 / 3.0, rel=0.02)
    height = disc.direction[{"y": 1, "z": 2}[up]]
    assert 0.4 < height < 0.7
    eye = camera.direction_of_view("three-quarter", up)
    assert eye_cosine[0] < float(eye @ disc.direction) < eye_cosine[1]
    overhead, below = (light.radiance(side * np.eye(3)[[{"y": 1, "z": 2}[up]]])[0] for side in (1.0, -1.0))
    assert (overhead > 3.0 * below).all()


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return make_scene(tmp_path_factory.mktemp("ball"), sphere(2))


def constant(value):
    return Network(lambda incident, positions, outgoing: np.full((*incident.shape[:2], 3), value))


@pytest.mark.statistics
@pytest.mark.parametrize("sun", SUNS)
def test_the_error_agrees_with_independent_pictures(scene, sun):
    """The picture of a constant network is Ŝ times the fluence, known without rendering."""
    light, view = sun_and_sky(scene, sun), camera.fit(scene.mesh, SIZE, SIZE, up=scene.up)
    first, second = (render_scene(scene, light, view, 16, seed, background=False).image for seed in (7, 8))
    coverage = render_scene(scene, light, view, 4, 9, background=False).coverage >= 1.0
    first, second = (part[coverage].astype(np.float64) for part in (first, second))
    (sky,), (disc,) = light.skies, light.suns
    total = fluence(sky.image) + disc.irradiance
    value = float(np.median(first.mean(axis=1)) / total.mean())
    found = picture_error(constant(value), scene, sun, 2.0, 3)
    expected = np.sqrt(np.mean((value * total - first) * (value * total - second)) / np.mean(first * second))
    assert found["error"] == pytest.approx(expected, rel=0.1)
    assert 0.0 < found["flip_of_noise"] < found["flip"] < 1.0
    assert found["flip_without_noise"] <= found["flip"]
    assert found["walks"] >= 8
    # All of the difference is on the object, apart from FLIP's filters across its silhouette.
    share = 0.5 * coverage.mean(), 1.5 * coverage.mean()
    assert share[0] < found["flip"] / found["on_object"]["flip"] < share[1]
    picture = np.asarray(Image.open(io.BytesIO(base64.b64decode(found["webp"]))))
    shown = ENLARGED * SIZE
    assert picture.shape == (shown, 3 * shown, 3)
    middle = slice(ENLARGED // 2, None, ENLARGED)
    ours, theirs, flip = (part[middle, middle] for part in np.split(picture.astype(np.float64), 3, axis=1))
    # A few pixels at the silhouette are fully covered by four rays but only partly by more.
    assert np.ptp(np.percentile(ours[coverage], [10, 90], axis=0), axis=0).max() <= 2.0
    assert np.ptp(theirs[coverage], axis=0).min() > 50.0
    np.testing.assert_array_equal(flip[..., 0], flip[..., 2])


def test_pictures_depend_on_the_seed_alone(scene, monkeypatch):
    """The half buffers have separate seeds, and another seed shares none of them."""
    seeds = []

    def traced(*arguments, **_options):
        seeds.append(arguments[4])
        return render_scene(*arguments[:3], 4, arguments[4], background=False)

    monkeypatch.setattr(training_picture, "render_scene", traced)
    monkeypatch.setattr(training_picture, "ENLARGED", 1)
    found = [picture_error(constant(0.05), scene, "aside", 1.0, seed)["flip"] for seed in (0, 1, 0)]
    assert found[0] == found[2] != found[1]
    assert len(set(seeds)) == 4


@pytest.mark.parametrize(
    ("flip", "without", "expected"),
    [(0.9, 0.5, "met"), (1.4, 1.2, "not met"), (1.5, 0.9, "undecided"), (1.0, 1.0, "met"), (1.01, 1.01, "not met")],
)
def test_the_interval_of_flip_contains_its_value_and_decides(flip, without, expected):
    row = picture_criterion({"sun": "behind", "flip": flip * FLIP, "flip_without_noise": without * FLIP})
    assert row["low"] <= row["value"] == without * FLIP <= row["high"]
    assert row["result"] == expected
    if without < flip:
        assert row["low"] < row["value"] < row["high"] < flip * FLIP


def test_flip_of_noise_alone_may_be_nothing():
    """FLIP of noise grows as the 0.35th power of its variance: doubled noise has 1.275 times the FLIP."""
    doubled = 2.0**0.35
    row = picture_criterion({"sun": "behind", "flip": 1.0, "flip_without_noise": np.sqrt(2.0 - doubled**2)})
    assert row["low"] == pytest.approx(0.0, abs=1e-4)
    assert row["result"] == "undecided"


@pytest.mark.parametrize(
    ("error", "words"), [(0.031, "is 3.1%, the ref"), (np.nan, "unknown: noise"), (None, "unknown")]
)
def test_an_error_that_noise_hides_is_unknown(error: float | None, words: str) -> None:
    """It is NaN in memory and null in a file."""
    flips = {"flip": 0.1, "flip_of_noise": 0.05}
    entry = {"light": "a sun", "error": error, "noise": 0.04, **flips, "on_object": flips}
    assert words in picture_summary(entry)
    assert "nan" not in picture_summary(entry)


def test_a_black_object_has_no_picture(tmp_path):
    black = make_scene(tmp_path, sphere(1), albedo=0.0)
    with pytest.raises(QueryError, match="no light reaches it"):
        picture_error(constant(0.05), black, "aside", 0.1, 0)
