"""How far light travels: the diffusion equation, its limits, and what info and check say of a scene."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_bvp

from formats.mesh import build_mesh, flipped, write_mesh
from formats.scene.materials import materials, to_scene_units
from prt_bake.inspection.files import describe, find_faults, find_remarks
from prt_bake.inspection.translucency import remark, translucency
from tests.tracer.scenes import sphere

SIZE = 10.0


@pytest.mark.parametrize(("sigma_s", "sigma_a"), [(20.0, 0.05), (20.0, 1.0), (200.0, 0.01), (3.0, 2.0)])
def test_the_crossing_is_that_of_the_diffusion_equation(sigma_s, sigma_a):
    """D φ″ = σa φ − δ(z − ℓ), φ = 0 at 2/3 ℓ outside either face: the flux that leaves by the other face."""
    extinction = sigma_s + sigma_a
    path, width = 1 / extinction, SIZE / 10
    diffusion, end = path / 3, width + 2 / 3 * path
    source = np.array([-2 / 3 * path, path, end])

    def slope(z, y):
        return np.array([y[1], sigma_a / diffusion * y[0]])

    # On either side of the source φ is the solution that vanishes at the boundary there.
    far = solve_bvp(slope, lambda a, b: [a[0] - 1, b[0]], np.linspace(path, end, 200), np.zeros((2, 200)), tol=1e-8)
    near = solve_bvp(slope, lambda a, b: [a[0], b[0] - 1], np.linspace(source[0], path, 50), np.zeros((2, 50)))
    height = 1 / (diffusion * (near.y[1, -1] - far.y[1, 0]))  # the flux jumps by 1 at the source
    expected = -diffusion * height * far.y[1, -1]
    light = translucency(np.full(3, sigma_s), np.full(3, sigma_a), 0.0, SIZE)
    np.testing.assert_allclose(light.crossing, expected, rtol=2e-3)


@settings(max_examples=60, deadline=None, derandomize=True, database=None)
@given(
    scattering=st.floats(1e-6, 1e9), absorption=st.floats(0, 1e9), g=st.floats(-0.99, 0.99), size=st.floats(1e-3, 1e6)
)
def test_every_share_is_one_and_falls_with_the_size(scattering, absorption, g, size):
    one, larger = (
        translucency(np.full(3, scattering), np.full(3, absorption), g, side).crossing for side in (size, 2 * size)
    )
    assert ((one >= 0) & (one <= 1)).all()
    assert (larger <= one + 1e-12).all()


def test_the_phase_function_changes_the_path_and_not_what_crosses():
    substance = [to_scene_units(materials()["marble"], g, 1.0) for g in (0.0, 0.8)]
    isotropic, forward = (
        translucency(each.sigma_s, each.sigma_t - each.sigma_s, g, 140.0)
        for each, g in zip(substance, (0.0, 0.8), strict=True)
    )
    np.testing.assert_allclose(forward.crossing, isotropic.crossing, rtol=1e-9)
    assert (forward.mean_free_path < 0.25 * isotropic.mean_free_path).all()


@pytest.mark.parametrize("g", [0.0, 0.8])
def test_clear_is_a_twentieth_of_white_light_straight_through(g):
    """exp(−3) = 0.050 in grey; with one channel alone exp(−L) = 0.15, at L = 1.9. Forward scattering counts less."""

    def clear(*paths):
        return translucency(np.array(paths) / SIZE / (1 - g), np.zeros(3), g, SIZE).clear

    assert clear(2.99, 2.99, 2.99)
    assert not clear(3.0, 3.0, 3.0)
    assert clear(1.89, 50.0, 50.0)
    assert not clear(1.9, 50.0, 50.0)


@pytest.mark.parametrize("paths", [5.01, 49.9])
def test_sizes_that_remarks_name_have_no_remark(paths):
    for material in materials().values():
        scattering, absorption = np.array(material.sigma_s_reduced), np.array(material.sigma_a)
        size = paths / (scattering + absorption).min()
        light = translucency(scattering, absorption, 0.0, size)
        assert not light.scatters or remark(light, 1.0) == "", material.name


SCENE = """[object]
mesh = "ball.ply"
unit = "cm"
[interface]
eta = 1.4
normals = "vertex"
[medium]
sigma_t = 5.0
albedo = 0.9
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes")
    ball = sphere(1)
    write_mesh(ball, folder / "ball.ply")
    write_mesh(flipped(ball), folder / "inverted.ply")
    return folder


def remarks(folder, *replaced):
    text = SCENE
    for old, new in replaced:
        text = text.replace(old, new)
    (folder / "scene.toml").write_text(text)
    assert find_faults(folder / "scene.toml") == []
    return find_remarks(folder / "scene.toml")


def test_check_remarks_on_opaque_and_clear_objects(folder):
    assert remarks(folder) == []
    (opaque,) = remarks(folder, ("5.0", "5000.0"))
    assert "it will look opaque: the transport mean free path is 0.002 mm in an object of 20 mm, and less" in opaque
    assert "an object of some 5 to 50 transport mean free paths: here a longest side of 0.01 to 0.1 mm, or" in opaque
    assert opaque.endswith("or 0.0005 to 0.005 times the sigma_t (of a material, density)")
    (clear,) = remarks(folder, ("5.0", "0.2"))
    assert "it is almost clear: the transport mean free path is 50 mm in an object of 20 mm, and 67 % of" in clear
    assert clear.endswith(
        "here a longest side of 250 to 2,500 mm, or 12 to 120 times the sigma_t (of a material, density)"
    )
    (absorbing,) = remarks(folder, ("5.0", "0.2"), ("0.9", "0.3"))
    assert "it absorbs more than it scatters, so no size or density looks translucent: raise albedo" in absorbing
    (unknown,) = remarks(folder, ("5.0", "5000.0"), ('unit = "cm"', ""))
    assert "0.0002 scene units in an object of 2 scene units" in unknown
    seed = '[[inside]]\nname = "seed"\nmesh = "ball.ply"\nsurface = "diffuse"\nreflectance = 0.5\n'
    assert not any("clear" in remark for remark in remarks(folder, ("5.0", "0.2"), ("0.9\n", f"0.9\n{seed}")))


def test_a_wall_is_the_thin_part_of_a_cup(folder):
    """Much light crosses the wall of a shell, and none a tenth of its longest side."""
    outer, inner = sphere(2), sphere(2)
    faces = np.concatenate([outer.faces, inner.faces[:, ::-1] + len(outer.positions)])
    write_mesh(build_mesh(np.concatenate([outer.positions, 0.99 * inner.positions]), faces), folder / "shell.ply")
    dense = ("5.0", "200.0"), ("0.9", "0.95")
    assert "its thin parts of 2 mm" in remarks(folder, *dense)[0]
    assert remarks(folder, *dense, ("ball.ply", "shell.ply")) == []
    found = describe(folder / "scene.toml")
    assert found["thin parts"] == "0.0985 mm"
    expected = translucency(np.full(3, 19.0), np.full(3, 1.0), 0.0, 20.0, 0.0985).percent_crossing
    assert found["diffuse light through thin parts"] == expected


def test_check_remarks_on_a_mesh_that_only_scenes_turn(folder):
    (sentence,) = remarks(folder, ("ball", "inverted"))
    assert "inverted.ply: the faces are wound inside out; flip the normals (the scene is rendered as if" in sentence


def test_info_has_the_mean_free_paths_beside_the_size(folder):
    (folder / "scene.toml").write_text(SCENE.replace("0.9\n", "[0.9, 0.8, 1.0]\nphase_g = 0.5\n"))
    found = describe(folder / "scene.toml")
    assert found["longest side"] == "20 mm"
    assert found["mean free path"] == "2 mm"
    assert found["transport mean free path"] == "3.64, 3.33, 4 mm"
    assert found["diffuse mean free path"] == "4.92, 3.33, unlimited mm"
    assert found["longest side in transport mean free paths"] == "5.5, 6, 5"
    (folder / "scene.toml").write_text(SCENE.replace("5.0", "0.0"))
    assert "mean free path" not in describe(folder / "scene.toml")
