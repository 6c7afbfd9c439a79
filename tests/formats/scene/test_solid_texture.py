"""Solid textures: reproducible noise, resolution independence, and mixtures of two substances."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from formats.errors import SceneError
from formats.mesh import build_mesh, write_mesh
from formats.scene import read_scene
from formats.scene.solid_texture import THRESHOLDS, blend_weight, gradient_noise
from tests.mathematics.significance import FALSE_ALARM
from tests.tracer.scenes import moved, sphere

PATTERNS = sorted(THRESHOLDS)
GOLDEN_NOISE = (
    [-0.010073534278035368, -0.11606593423014419, -0.2495021924182268],
    [-0.11234517854427395, 0.12561167814696367, 0.12936263456083452],
)
GOLDEN_WEIGHTS = {"noise": [12279, 45430, 40436], "turbulence": [16643, 20004, 22034], "veins": [0, 7379, 35526]}


def random_points(count, span=50.0, seed=1):
    return np.random.default_rng(seed).uniform(-span, span, (count, 3))


def test_the_noise_is_reproducible():
    points = np.array([[0.5, 0.25, 0.75], [-3.3, 7.1, 0.01], [1e6 + 0.5, -2e5 + 0.25, 0.125]])
    np.testing.assert_array_equal(gradient_noise(points, 0), GOLDEN_NOISE[0])
    np.testing.assert_array_equal(gradient_noise(points, 2**63 - 1, 3), GOLDEN_NOISE[1])
    for pattern in PATTERNS:
        w = blend_weight(points, pattern, 0.7, seed=5, thresholds=(0, 1))
        np.testing.assert_array_equal(w * 2**16, GOLDEN_WEIGHTS[pattern])


def test_the_noise_is_0_at_lattice_points_and_bounded():
    corners = np.random.default_rng(1).integers(-1000, 1000, (500, 3)).astype(np.float64)
    np.testing.assert_array_equal(gradient_noise(corners, 7), 0)
    assert np.abs(gradient_noise(random_points(20_000), 7)).max() < 1.5


def test_the_noise_and_its_gradient_are_continuous_across_cells():
    faces = random_points(2000)
    faces[:, 0] = np.rint(faces[:, 0])
    step = np.array([1e-5, 0, 0])
    before, at, after = (gradient_noise(faces + k * step, 3) for k in (-1, 0, 1))
    assert np.abs(after - before).max() < 1e-4
    # The second difference of a function with a continuous gradient is of the order of the squared step.
    assert np.abs(after - 2 * at + before).max() < 1e-8


def test_octaves_have_variance_1_and_mean_0():
    """Cells at distance 3 share no corner, so their values are independent; z-tests of sample mean and variance."""
    cells = 3.0 * np.stack(np.meshgrid(*[np.arange(30)] * 3), axis=-1).reshape(-1, 3)
    field = gradient_noise(cells + np.random.default_rng(2).random(cells.shape), 11) / 0.1909436
    limit = stats.norm.isf(FALSE_ALARM / 4)
    assert abs(field.mean()) < limit / np.sqrt(len(field))
    squares = field**2
    assert abs(squares.mean() - 1) < limit * squares.std() / np.sqrt(len(field))


@pytest.mark.parametrize("pattern", PATTERNS)
@settings(max_examples=20, deadline=None, derandomize=True, database=None)
@given(seed=st.integers(0, 2**63 - 1), feature=st.floats(1e-3, 1e3), octaves=st.integers(1, 10))
def test_weights_are_between_0_and_1_and_scale_with_the_feature(pattern, seed, feature, octaves):
    points = random_points(200, 3.0)
    w = blend_weight(points * feature, pattern, feature, seed, octaves)
    assert ((w >= 0) & (w <= 1)).all()
    assert (w * 2**16 == np.rint(w * 2**16)).all()
    # Scaling by a power of two is exact.
    np.testing.assert_array_equal(
        blend_weight(points * 8, pattern, 8.0, seed, octaves), blend_weight(points, pattern, 1.0, seed, octaves)
    )


@pytest.mark.parametrize("pattern", PATTERNS)
def test_patterns_of_different_seeds_are_uncorrelated(pattern):
    points = random_points(1000)
    fields = [blend_weight(points, pattern, 1.0, seed, thresholds=(0, 1)) for seed in range(4)]
    for i in range(4):
        for j in range(i):
            assert abs(np.corrcoef(fields[i], fields[j])[0, 1]) < 0.2  # 6 standard errors


@pytest.mark.parametrize("pattern", PATTERNS)
def test_the_default_thresholds_give_both_substances(pattern):
    w = blend_weight(random_points(20_000), pattern, 1.0)
    assert 0.05 < w.mean() < 0.6
    assert (w == 0).mean() > 0.1
    assert (w == 1).mean() > 0.005


SCENE = """
[object]
mesh = "ball.ply"
unit = "cm"
[medium]
sigma_t = 4.0
albedo = [0.2, 0.4, 0.6]
phase_g = 0.25
[medium.mix]
sigma_t = 8.0
albedo = 0.9
pattern = "noise"
feature = 0.5
seed = 3
resolution = 12
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mixed")
    write_mesh(sphere(1), folder / "ball.ply")
    return folder


def scene(folder, *changes):
    text = SCENE
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (folder / "scene.toml").write_text(text)
    return read_scene(folder / "scene.toml")


def test_a_mixture_is_a_grid_over_the_part_s_box(folder):
    read = scene(folder)
    assert read.sigma_t.shape == (12, 12, 12)
    assert read.albedo.shape == (12, 12, 12, 3)
    assert read.phase_g == 0.25
    low, high = read.bounds
    assert ((low < read.mesh.bounds[0]) & (low > read.mesh.bounds[0] - 0.01)).all()
    assert ((high > read.mesh.bounds[1]) & (high < read.mesh.bounds[1] + 0.01)).all()


def test_scattering_and_absorption_are_blended_linearly(folder):
    read = scene(folder)
    w = (read.sigma_t - 4.0) / 4.0
    assert 0.1 < w.mean() < 0.9
    assert ((w >= 0) & (w <= 1)).all()
    scattering = (1 - w[..., None]) * 4.0 * np.array([0.2, 0.4, 0.6]) + w[..., None] * 8.0 * 0.9
    np.testing.assert_allclose(read.albedo * read.sigma_t[..., None], scattering, rtol=1e-12)


def test_the_weight_of_a_cell_is_that_of_its_centre(folder):
    read = scene(folder, ("resolution = 12", "resolution = 7"))
    low, high = read.bounds
    index = np.array([5, 0, 3])  # z, y, x
    centre = low + (index[::-1] + 0.5) / 7 * (high - low)
    w = blend_weight(centre, "noise", 0.5, 3)
    np.testing.assert_allclose(read.sigma_t[tuple(index)], 4 + 4 * w, rtol=1e-12)


def test_a_finer_grid_samples_the_same_field(folder):
    coarse, fine = (scene(folder, ("resolution = 12", f"resolution = {n}")) for n in (11, 33))
    np.testing.assert_array_equal(coarse.bounds, fine.bounds)
    # The middle one of three fine cells has the centre of the coarse cell.
    np.testing.assert_allclose(fine.sigma_t[1::3, 1::3, 1::3], coarse.sigma_t, atol=1e-3)


def test_cells_are_cubes_in_a_part_that_is_not_cubic(folder):
    ball = sphere(1)
    write_mesh(build_mesh(ball.positions * [2, 1, 0.5], ball.faces), folder / "long.ply")
    read = scene(folder, ("ball.ply", "long.ply"), ("resolution = 12", "resolution = 32"))
    assert read.sigma_t.shape == (8, 16, 32)


def test_materials_mix_by_channel_and_with_numbers(folder):
    marble = ("sigma_t = 8.0\nalbedo = 0.9", 'material = "marble"\ndensity = 0.5')
    ketchup = ("sigma_t = 4.0\nalbedo = [0.2, 0.4, 0.6]", 'material = "ketchup"')
    w = (scene(folder).sigma_t[..., None] - 4.0) / 4.0
    marble_sigma_t = 5 * (np.array([2.19, 2.62, 3.00]) / 0.75 + [0.0021, 0.0041, 0.0071])
    ketchup_sigma_t = 10 * (np.array([0.18, 0.07, 0.03]) / 0.75 + [0.061, 0.97, 1.45])
    both = scene(folder, marble, ketchup).sigma_t
    np.testing.assert_allclose(both, (1 - w) * ketchup_sigma_t + w * marble_sigma_t, rtol=1e-12)
    np.testing.assert_allclose(scene(folder, marble).sigma_t, (1 - w) * 4 + w * marble_sigma_t, rtol=1e-12)


def test_thresholds_out_of_range_give_one_substance(folder):
    for thresholds, sigma_t in ((("10", "11"), 4.0), (("-11", "-10"), 8.0)):
        read = scene(folder, ("seed = 3", f"thresholds = [{', '.join(thresholds)}]"))
        np.testing.assert_array_equal(read.sigma_t, sigma_t)


def test_the_mixture_of_an_inner_part_fills_its_box(folder):
    write_mesh(moved(sphere(1), 0.5, [0.2, 0, 0]), folder / "core.ply")
    head, mix = SCENE.split("[medium]\n")
    inner = '[medium]\nsigma_t = 1\nalbedo = 1\n[[inside]]\nname = "core"\nmesh = "core.ply"\n'
    (folder / "scene.toml").write_text(
        head + inner + "[inside.medium]\n" + mix.replace("medium.mix", "inside.medium.mix")
    )
    core = read_scene(folder / "scene.toml").parts[1]
    assert core.medium.sigma_t.shape == (12, 12, 12)
    np.testing.assert_allclose(core.medium.bounds, core.mesh.bounds, atol=2e-3)


def test_the_hash_depends_on_the_pattern(folder):
    changes = [("seed = 3", "seed = 4"), ("feature = 0.5", "feature = 0.6"), ('"noise"', '"veins"'), ("= 12", "= 13")]
    changes += [("seed = 3", "seed = 3\noctaves = 2"), ("seed = 3", "thresholds = [0.4, 0.7]"), ("8.0", "8.1")]
    assert len({scene(folder, change).content_hash for change in changes} | {scene(folder).content_hash}) == 8


FAULTS = [
    ('"noise"', '"marbled"', 'medium.mix.pattern: expected "noise", "veins" or "turbulence", found \'marbled\''),
    ("feature = 0.5", "", "medium.mix.feature: is missing; expected a positive length in scene units"),
    ("feature = 0.5", "feature = 0", "medium.mix.feature: expected a positive length"),
    ("seed = 3", "seed = -1", "medium.mix.seed: expected an integer from 0"),
    ("seed = 3", "octaves = 11", "medium.mix.octaves: expected an integer from 1 to 10"),
    ("seed = 3", "thresholds = [0.6, 0.4]", "medium.mix.thresholds: the first threshold must be below the second"),
    ("seed = 3", "thresholds = [0.6]", "medium.mix.thresholds: expected two numbers, the lower one first"),
    ("= 12", "= 1000", "medium.mix.resolution: expected an integer number of cells from 2 to 256"),
    ("seed", "sead", "medium.mix.sead: unknown key; did you mean 'seed'?"),
    ("sigma_t = 8.0", "", "medium.mix.sigma_t: is missing; expected one number that is not negative"),
    (
        "sigma_t = 8.0",
        'sigma_t = "a.npy"',
        "medium.mix.sigma_t: expected one number that is not negative, or three of them",
    ),
    ("sigma_t = 8.0", 'material = "soup"', "medium.mix.albedo: the material 'soup' defines it already"),
    ("sigma_t = 4.0", 'sigma_t = "a.npy"', "medium.sigma_t: a mixture needs numbers or a material, not a grid"),
    ("sigma_t = 8.0\nalbedo = 0.9", 'material = "soup"', "medium.mix.material: unknown material 'soup'"),
]


@pytest.mark.parametrize(("old", "new", "sentence"), FAULTS)
def test_every_error_names_its_key(folder, old, new, sentence):
    with pytest.raises(SceneError) as caught:
        scene(folder, (old, new))
    assert str(caught.value).startswith(f"{folder / 'scene.toml'}: {sentence}")
    assert "\n" not in str(caught.value)
