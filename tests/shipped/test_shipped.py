"""What is shipped is sound, small and made the way it says."""

import json

import numpy as np
import pytest

from formats.image import read_image
from formats.scene import read_scene
from prt_bake.network.bssrdf import load_model
from prt_bake.shipped import demonstration, marble


def test_the_grids_are_what_their_generator_makes():
    sigma_t, albedo = marble.grids()
    np.testing.assert_allclose(np.load(demonstration.SHIPPED / "sigma_t.npy"), sigma_t, rtol=1e-5)
    np.testing.assert_allclose(np.load(demonstration.SHIPPED / "albedo.npy"), albedo, rtol=1e-5)


def test_the_scene_can_be_read_and_holds_the_whole_mesh():
    scene = read_scene(demonstration.SHIPPED / "spot.toml")
    low, high = scene.bounds
    assert (scene.mesh.positions >= low).all()
    assert (scene.mesh.positions <= high).all()
    np.testing.assert_array_equal(scene.bounds, marble.BOUNDS)


def test_the_model_was_trained_on_this_very_scene():
    network = load_model(demonstration.MODEL)
    scene = read_scene(demonstration.SHIPPED / "spot.toml")
    assert network.metadata["scene_hash"] == scene.content_hash
    assert network.metadata["training"]["seconds"] == pytest.approx(600, abs=5)
    assert (
        demonstration.MODEL.stat().st_size / 1024 <= 660
    )  # grids of where the object is and of what is learnt there included


def test_the_reference_has_the_size_and_the_noise_that_its_report_says():
    said = json.loads(demonstration.REFERENCE_REPORT.read_text())
    reference = read_image(demonstration.REFERENCE)
    assert reference.shape == (said["height"], said["width"], 3)
    assert 0 < said["relative_noise"] < 0.05
    # Neighbouring pixels on the object differ by little but their noise: what is left after smoothing is of its size.
    height, width = reference.shape[:2]
    patch = reference[height // 2 - 8 : height // 2 + 8, width // 2 - 24 : width // 2 - 8].astype(np.float64)
    second = patch[1:-1, 1:-1] * 4 - patch[:-2, 1:-1] - patch[2:, 1:-1] - patch[1:-1, :-2] - patch[1:-1, 2:]
    assert 0.2 < np.mean(second**2) / 20 / said["noise_mse"] < 5.0


def test_everything_shipped_is_small():
    sizes = {path.name: path.stat().st_size for path in demonstration.SHIPPED.iterdir() if path.is_file()}
    assert sum(sizes.values()) < 4_000_000, sizes
