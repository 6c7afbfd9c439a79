"""Measured materials: the reflectances of the paper, units of length, and errors that name the key."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from formats.errors import SceneError
from formats.mesh import write_mesh
from formats.scene import read_scene
from formats.scene.materials import find_material, materials, to_scene_units
from formats.scene.units import MILLIMETRES, read_length, unit_symbol
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


@pytest.mark.parametrize("name", REFLECTANCE)
def test_the_dipole_reproduces_the_printed_reflectances(name):
    material = materials()[name]
    computed = diffuse_reflectance(np.array(material.sigma_s_reduced), np.array(material.sigma_a), material.eta)
    printed = np.array(REFLECTANCE[name])
    known = np.isfinite(printed)
    np.testing.assert_allclose(computed[known], printed[known], atol=0.011)


@pytest.mark.parametrize(
    ("written", "name"),
    [
        *[("marble", "marble"), ("Skim Milk", "skimmilk"), ("whole-milk", "wholemilk"), ("SKIN", "skin1")],
        *[("chicken", "chicken1"), ("chicken 2", "chicken2"), ("skin_2", "skin2"), ("white_jade", "whitejade")],
        *[("Head & Shoulders Shampoo", "headshouldersshampoo"), ("milk", "wholemilk")],
    ],
)
def test_materials_are_found_in_any_spelling(written, name):
    assert find_material(written) is materials()[name]


# Scattering, not reduced, and g, as Mitsuba 0.6 has them in src/medium/materials.h: another transcription of the paper.
BY_DILUTION = {
    "lowfat milk": ((13.1157, 15.4445, 17.9572), (0.932, 0.902, 0.859)),
    "regular milk": ((18.2052, 20.3826, 22.3698), (0.75, 0.714, 0.681)),
    "espresso": ((7.78262, 8.1305, 8.53875), (0.907, 0.896, 0.88)),
    "gatorade": ((0.03668, 0.04488, 0.05742), (0.933, 0.933, 0.935)),
    "white grapefruit juice": ((0.50499, 0.52742, 0.75282), (0.548, 0.545, 0.565)),
    "suisse mocha powder": ((30.0848, 33.4452, 38.7191), (0.907, 0.894, 0.888)),
}


@pytest.mark.parametrize("name", BY_DILUTION)
def test_scattering_of_diluted_media_is_reduced(name):
    scattering, g = map(np.array, BY_DILUTION[name])
    np.testing.assert_allclose(find_material(name).sigma_s_reduced, scattering * (1 - g), rtol=2e-3)


def test_the_table_is_that_of_pbrt_and_estimates():
    table = materials().values()
    assert sum(material.measured for material in table) == 47
    for material in table:
        scattering, absorption = np.array([material.sigma_s_reduced, material.sigma_a])
        assert (scattering >= 0).all()
        assert (absorption >= 0).all()
        assert (scattering + absorption > 0).all()
        assert 0 <= material.roughness <= 1 < material.eta < 2
        assert ("estimate" in material.source) is not material.measured
        assert ("diluted product" in material.source) is ("in water" in material.group)


def test_units_are_read_by_symbol_and_word():
    assert [unit_symbol(name) for name in ("mm", "Centimetre", " METERS ", "in", "inches")] == [
        *("mm", "cm", "m", "inch", "inch")
    ]
    assert read_length("14cm") == 140
    assert read_length(" 1.5e2 millimetres") == 150
    assert read_length("2in") == pytest.approx(50.8)
    for text in ("14", "cm", "-3cm", "0cm", "14 parsec", "1e400m", "nan cm", "inf m", "", "14cmm"):
        with pytest.raises(ValueError, match="expected a positive length with its unit, such as 14cm"):
            read_length(text)


@settings(max_examples=50, deadline=None, derandomize=True, database=None)
@given(
    name=st.sampled_from(sorted(materials())),
    phase_g=st.floats(-0.95, 0.95),
    unit=st.sampled_from(sorted(MILLIMETRES)),
    density=st.floats(0.01, 100),
)
def test_reduced_scattering_and_absorption_do_not_depend_on_g(name, phase_g, unit, density):
    material = materials()[name]
    substance = to_scene_units(material, phase_g, MILLIMETRES[unit], density)
    per_mm = density * MILLIMETRES[unit]
    np.testing.assert_allclose(substance.sigma_s * (1 - phase_g) / per_mm, material.sigma_s_reduced, rtol=1e-12)
    np.testing.assert_allclose((substance.sigma_t - substance.sigma_s) / per_mm, material.sigma_a, rtol=1e-9, atol=1e-9)
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
    words = scene(folder, SCENE.replace('"cm"', '"Centimetres"'))
    assert (words.unit, words.content_hash) == ("cm", read.content_hash)
    thumbs = scene(folder, SCENE.replace('"cm"', '"thumb"\nunit_in_mm = 20.0'))
    np.testing.assert_allclose(thumbs.sigma_t, 2 * read.sigma_t, rtol=1e-12)
    assert thumbs.unit == "20 mm"


def test_an_inner_part_may_have_a_material(folder):
    inner = '[[inside]]\nname = "core"\nmesh = "ball.ply"\n[inside.medium]\nmaterial = "ketchup"\n'
    read = scene(folder, SCENE + inner)
    np.testing.assert_allclose(read.parts[1].medium.sigma_t, [2.41, 10.4, 14.8], rtol=1e-12)


def test_info_reports_that_eta_is_not_that_of_the_material(folder):
    scene(folder, SCENE)
    description = describe(folder / "scene.toml")
    assert description["material"] == "marble, measured with eta 1.5; the scene uses eta 1"
    scene(folder, SCENE + "density = 0.1\n")
    assert describe(folder / "scene.toml")["material"].startswith("marble of density 0.1, measured with")


FAULTS = [
    ("marble", "marbel", "medium.material: unknown material 'marbel'; did you mean 'marble' or 'marble vein'?"),
    ("marble", "plutonium", "medium.material: unknown material 'plutonium'; `prtbake materials` lists all"),
    ('"cm"', '"unit"', "object.unit: 'marble' is known per millimetre, but 'unit' is not a known unit of length"),
    ('"cm"', '"cm"\nunit_in_mm = 1', "object.unit: 'cm' has 10 millimetres, but unit_in_mm is 1; remove one of them"),
    ('"cm"', '"centimeter"\nunit_in_mm = 1', "object.unit: 'centimeter' has 10 millimetres, but unit_in_mm is 1"),
    ('"cm"', '"centimters"', "object.unit: 'centimters' is not a known unit of length; did you mean 'centimeters'?"),
    ('"cm"', '"parsec"', "object.unit: 'parsec' is not a known unit of length; expected one of mm, cm, dm, m, inch"),
    ('"cm"', '"cm"\nunit_in_mm = 0', "object.unit_in_mm: expected a positive number of millimetres, found 0"),
    ('"marble"', '"marble"\nsigma_t = 1', "medium.sigma_t: the material 'marble' defines it already"),
    ('"marble"', '"marble"\nalbedo = 1', "medium.albedo: the material 'marble' defines it already"),
    ('"marble"', '"marble"\ndensity = 0', "medium.density: expected a positive number, found 0"),
    ('material = "marble"', "", "medium.sigma_t: is missing; expected one number that is not negative, three of them"),
    ('material = "marble"', "sigma_t = 1", "medium.albedo: is missing; expected a number from 0 to 1"),
    ('material = "marble"', "sigma_t = 1\nalbedo = 1\ndensity = 2", "medium.density: needs a material"),
]


@pytest.mark.parametrize("name", materials())
def test_every_material_loads_in_a_scene(folder, name):
    read = scene(folder, SCENE.replace("marble", name))
    absorption = read.sigma_t * (1 - read.albedo)
    np.testing.assert_allclose(absorption / 10, materials()[name].sigma_a, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(("old", "new", "sentence"), FAULTS)
def test_every_error_names_its_key(folder, old, new, sentence):
    with pytest.raises(SceneError) as caught:
        scene(folder, SCENE.replace(old, new))
    assert str(caught.value).startswith(f"{folder / 'scene.toml'}: {sentence}")
    assert "\n" not in str(caught.value)
