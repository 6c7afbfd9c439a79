"""Measured materials: the reflectances of the paper, units of length, and errors that name the key."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from formats.errors import SceneError
from formats.mesh import write_mesh
from formats.scene import read_scene
from formats.scene.materials import MATERIALS, MILLIMETRES, find_material, to_scene_units
from prt_bake.inspection.files import describe
from tests.tracer.scenes import sphere

# The column "diffuse reflectance" of the same figure. Blue of chicken1 is omitted: the figure's coefficients give 0.13,
# but it prints 0.10.
REFLECTANCE = {
    "apple": (0.85, 0.84, 0.53),
    "chicken1": (0.31, 0.15, np.nan),
    "chicken2": (0.32, 0.16, 0.10),
    "cream": (0.98, 0.90, 0.73),
    "ketchup": (0.16, 0.01, 0.00),
    "marble": (0.83, 0.79, 0.75),
    "potato": (0.77, 0.62, 0.21),
    "skimmilk": (0.81, 0.81, 0.69),
    "skin1": (0.44, 0.22, 0.13),
    "skin2": (0.63, 0.44, 0.34),
    "spectralon": (1.00, 1.00, 1.00),
    "wholemilk": (0.91, 0.88, 0.76),
}


def diffuse_reflectance(sigma_s, sigma_a, eta):
    """The dipole's total diffuse reflectance, equation 15 of the same paper."""
    reduced_albedo = sigma_s / (sigma_s + sigma_a)
    fresnel = -1.440 / eta**2 + 0.710 / eta + 0.668 + 0.0636 * eta
    internal = (1 + fresnel) / (1 - fresnel)
    root = np.sqrt(3 * (1 - reduced_albedo))
    return reduced_albedo / 2 * (1 + np.exp(-4 / 3 * internal * root)) * np.exp(-root)


@pytest.mark.parametrize("name", MATERIALS)
def test_the_dipole_reproduces_the_printed_reflectances(name):
    material = MATERIALS[name]
    computed = diffuse_reflectance(np.array(material.sigma_s_reduced), np.array(material.sigma_a), material.eta)
    printed = np.array(REFLECTANCE[name])
    known = np.isfinite(printed)
    np.testing.assert_allclose(computed[known], printed[known], atol=0.011)


@pytest.mark.parametrize(
    ("written", "name"),
    [
        *[("marble", "marble"), ("Skim Milk", "skimmilk"), ("whole-milk", "wholemilk"), ("SKIN", "skin1")],
        *[("chicken", "chicken1"), ("chicken 2", "chicken2"), ("skin_2", "skin2")],
    ],
)
def test_materials_are_found_in_any_spelling(written, name):
    assert find_material(written) is MATERIALS[name]


@settings(max_examples=50, deadline=None, derandomize=True, database=None)
@given(
    name=st.sampled_from(sorted(MATERIALS)),
    phase_g=st.floats(-0.95, 0.95),
    unit=st.sampled_from(sorted(MILLIMETRES)),
    density=st.floats(0.01, 100),
)
def test_reduced_scattering_and_absorption_do_not_depend_on_g(name, phase_g, unit, density):
    substance = to_scene_units(MATERIALS[name], phase_g, MILLIMETRES[unit], density)
    per_mm = density * MILLIMETRES[unit]
    np.testing.assert_allclose(substance.sigma_s * (1 - phase_g) / per_mm, MATERIALS[name].sigma_s_reduced, rtol=1e-12)
    np.testing.assert_allclose(
        (substance.sigma_t - substance.sigma_s) / per_mm, MATERIALS[name].sigma_a, rtol=1e-9, atol=1e-9
    )
    np.testing.assert_allclose(substance.albedo * substance.sigma_t, substance.sigma_s, rtol=1e-12)
    assert (substance.albedo <= 1).all()


SCENE = '[object]\nmesh = "ball.ply"\nunit = "cm"\n[interface]\nroughness = 0.1\n[medium]\nmaterial = "marble"\n'


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("materials")
    write_mesh(sphere(1), folder / "ball.ply")
    return folder


def scene(folder, text):
    (folder / "scene.toml").write_text(text)
    return read_scene(folder / "scene.toml")


def test_a_material_is_converted_to_scene_units(folder):
    read = scene(folder, SCENE)
    np.testing.assert_allclose(read.sigma_t, [21.921, 26.241, 30.071], rtol=1e-12)
    np.testing.assert_allclose(read.albedo, [2.19 / 2.1921, 2.62 / 2.6241, 3.00 / 3.0071], rtol=1e-12)
    assert (read.eta, read.phase_g, read.bounds) == (1, 0, None)
    forward = scene(folder, SCENE + "phase_g = 0.5\ndensity = 0.1\n")
    np.testing.assert_allclose(forward.sigma_t, [4.3821, 5.2441, 6.0071], rtol=1e-12)
    inches = scene(folder, SCENE.replace('"cm"', '"inch"'))
    np.testing.assert_allclose(inches.sigma_t, 2.54 * read.sigma_t, rtol=1e-12)
    thumbs = scene(folder, SCENE.replace('"cm"', '"thumb"\nunit_in_mm = 20.0'))
    np.testing.assert_allclose(thumbs.sigma_t, 2 * read.sigma_t, rtol=1e-12)


def test_an_inner_part_may_have_a_material(folder):
    inner = '[[inside]]\nname = "core"\nmesh = "ball.ply"\n[inside.medium]\nmaterial = "ketchup"\n'
    read = scene(folder, SCENE + inner)
    np.testing.assert_allclose(read.parts[1].medium.sigma_t, [2.41, 10.4, 14.8], rtol=1e-12)


def test_info_reports_that_eta_is_not_that_of_the_material(folder):
    scene(folder, SCENE)
    description = describe(folder / "scene.toml")
    assert description["material"] == "marble, measured with eta 1.5; the scene uses eta 1"


FAULTS = [
    ("marble", "marbel", "medium.material: unknown material 'marbel'; did you mean 'marble'?"),
    ("marble", "plutonium", "medium.material: unknown material 'plutonium'; expected one of apple, chicken, "),
    ('"cm"', '"unit"', "object.unit: 'marble' is measured per millimetre, but 'unit' is not a known unit of length"),
    ('"cm"', '"cm"\nunit_in_mm = 1', "object.unit_in_mm: is 1, but the unit 'cm' has 10 millimetres"),
    ('"cm"', '"cm"\nunit_in_mm = 0', "object.unit_in_mm: expected a positive number of millimetres, found 0"),
    ('"marble"', '"marble"\nsigma_t = 1', "medium.sigma_t: the material 'marble' defines it already"),
    ('"marble"', '"marble"\nalbedo = 1', "medium.albedo: the material 'marble' defines it already"),
    ('"marble"', '"marble"\ndensity = 0', "medium.density: expected a positive number, found 0"),
    ('material = "marble"', "", "medium.sigma_t: is missing; expected one number that is not negative, three of them"),
    ('material = "marble"', "sigma_t = 1", "medium.albedo: is missing; expected a number from 0 to 1"),
    ('material = "marble"', "sigma_t = 1\nalbedo = 1\ndensity = 2", "medium.density: needs a material"),
]


@pytest.mark.parametrize(("old", "new", "sentence"), FAULTS)
def test_every_error_names_its_key(folder, old, new, sentence):
    with pytest.raises(SceneError) as caught:
        scene(folder, SCENE.replace(old, new))
    assert str(caught.value).startswith(f"{folder / 'scene.toml'}: {sentence}")
    assert "\n" not in str(caught.value)
