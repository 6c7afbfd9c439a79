"""The shipped files are valid, small and reproducible."""

import json

import numpy as np

from formats.image import read_image
from formats.scene import read_scene
from prt_bake.network.bssrdf import load_model
from prt_bake.shipped import demonstration, marble


def test_the_grids_are_reproducible():
    sigma_t, albedo = marble.grids()
    np.testing.assert_allclose(np.load(demonstration.SHIPPED / "sigma_t.npy"), sigma_t, rtol=1e-5)
    np.testing.assert_allclose(np.load(demonstration.SHIPPED / "albedo.npy"), albedo, rtol=1e-5)


def test_the_grids_contain_the_mesh():
    scene = read_scene(demonstration.SHIPPED / "spot.toml")
    low, high = scene.bounds
    assert (scene.mesh.positions >= low).all()
    assert (scene.mesh.positions <= high).all()
    np.testing.assert_array_equal(scene.bounds, marble.BOUNDS)


def test_the_model_was_trained_on_the_shipped_scene():
    network = load_model(demonstration.MODEL)
    scene = read_scene(demonstration.SHIPPED / "spot.toml")
    assert network.metadata["scene_hash"] == scene.content_hash
    assert network.metadata["training"]["relative_rmse"]["coefficients"] < 0.05
    assert demonstration.MODEL.stat().st_size <= 1416 * 1024  # the most that a network may have, with its grids


def test_the_reference_has_the_size_and_noise_of_its_report():
    report = json.loads(demonstration.REFERENCE_REPORT.read_text())
    reference = read_image(demonstration.REFERENCE)
    assert reference.shape == (report["height"], report["width"], 3)
    assert 0 < report["relative_noise"] < 0.05
    # Neighbouring pixels on the object differ mostly by noise: the Laplacian estimates its variance.
    height, width = reference.shape[:2]
    patch = reference[height // 2 - 8 : height // 2 + 8, width // 2 - 24 : width // 2 - 8].astype(np.float64)
    second = patch[1:-1, 1:-1] * 4 - patch[:-2, 1:-1] - patch[2:, 1:-1] - patch[1:-1, :-2] - patch[1:-1, 2:]
    assert 0.2 < np.mean(second**2) / 20 / report["noise_mse"] < 5.0


def test_the_shipped_files_are_small():
    sizes = {path.name: path.stat().st_size for path in demonstration.SHIPPED.iterdir() if path.is_file()}
    assert sum(sizes.values()) < 4_000_000, sizes
