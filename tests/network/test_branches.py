"""View rays that interfaces split: what is seen by reflection and by refraction, with the light that each brings."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import NDArray

from prt_bake.mathematics.fresnel import fresnel
from prt_bake.network.bssrdf import PRESETS
from prt_bake.network.features.interior import LEVELS, Interior
from prt_bake.network.features.path_kernel import _LEAST_BRANCH
from prt_bake.network.features.view_path import Body, PathSamples, ViewPath, path_through

Array = NDArray[np.float64]
ETA, TURNS, BRANCHES = 1.5, 64, PRESETS["measured"].branches
CRITICAL = float(np.degrees(np.arcsin(1.0 / ETA)))


def plate(bottom: float, top: float, attenuation: float, parent: int = -1, eta: float = ETA) -> Body:
    """Wide enough for every path."""
    mesh = trimesh.creation.box(bounds=np.array([[-400.0, -400.0, bottom], [400.0, 400.0, top]]))
    return Body(np.asarray(mesh.vertices), np.asarray(mesh.faces), parent=parent, eta=eta, attenuation=attenuation)


def seen(bodies: list[Body], degrees: float, samples: int = 12, branches: int = BRANCHES) -> PathSamples:
    """The path from the middle of a plate's upper face, at z = 1, downwards."""
    angle = np.radians(degrees)
    towards = torch.tensor([[np.sin(angle), 0.0, -np.cos(angle)]])
    start = torch.tensor([[0.1, 0.2, 1.0]], dtype=torch.float64)
    return ViewPath(bodies, samples, TURNS, branches)(start, -towards)


def reflectance(degrees: float) -> float:
    return float(fresnel(np.cos(np.radians(degrees)), 1.0 / ETA))


@pytest.mark.parametrize("attenuation", [0.02, 0.5, 3.0])
@pytest.mark.parametrize("short_of_critical", [30.0, 5.0, 1.0, 0.1, 1e-3, -1.0])
def test_a_plate_absorbs_as_the_sum_over_its_reflections(attenuation: float, short_of_critical: float) -> None:
    """The faces reflect R of the light each: a ray sees (1 − e⁻ᵗ) Σ (R e⁻ᵗ)ᵏ, t the optical depth from face to face.

    What is missing are branches that begin with less than the least share, or reflections beyond the last one.
    """
    degrees = CRITICAL - short_of_critical
    part, once = reflectance(degrees), np.exp(-attenuation / np.cos(np.radians(degrees)))
    whole = (1.0 - once) / (1.0 - part * once)
    opacity = float(seen([plate(0.0, 1.0, attenuation)], degrees).opacity[0])
    dropped = max(_LEAST_BRANCH, (part * once) ** TURNS)
    assert whole * (1.0 - dropped) - 1e-6 <= opacity <= whole + 1e-6
    refracted = float(seen([plate(0.0, 1.0, attenuation)], degrees, branches=1).opacity[0])
    assert refracted == pytest.approx(1.0 - once ** (1 if part < 1.0 else TURNS + 1), rel=1e-5)


def test_points_are_shared_out_by_the_light_of_the_branches() -> None:
    """Behind a plate of glass stands a dark one: it is seen with the light that two faces and the air let through."""
    degrees = CRITICAL - 0.2
    glass, dark = plate(0.0, 1.0, 0.3), plate(-2.0, -1.0, 0.3)
    both = np.concatenate([glass.positions, dark.positions]), np.concatenate([glass.faces, dark.faces + 8])
    body = glass._replace(positions=both[0], faces=both[1])
    inner = plate(-1.9, -1.0 - 1e-6, 1e5, parent=0)
    samples = seen([body, inner], degrees, samples=400)
    part, once = reflectance(degrees), np.exp(-0.3 / np.cos(np.radians(degrees)))
    assert 0.5 < part < 0.8
    in_glass = float((samples.points[0, :, 2] > -0.5).double().mean() * samples.opacity[0])
    behind = float(samples.opacity[0]) - in_glass
    assert in_glass >= (1.0 - once) / (1.0 - part * once) * (1.0 - _LEAST_BRANCH) - 0.01
    # Between the plates light goes to and fro, so that one face alone lets as much through as both, or more.
    leaving = once * (1.0 - part)
    assert leaving * (1.0 - part) - 0.01 <= behind <= leaving / (1.0 - part * once) + 0.01
    z = samples.points[0, :, 2]
    assert float(z[z <= -0.5].max()) == pytest.approx(-1.0, abs=1e-3)


def test_the_larger_part_comes_first() -> None:
    """Of the light on a face beyond R = ½ the reflected part goes on, and it leaves where it is refracted less."""
    faint = [plate(0.0, 1.0, 1e-3)]
    up = seen(faint, CRITICAL - 1e-3)
    down = seen(faint, CRITICAL - 5.0)
    assert reflectance(CRITICAL - 1e-3) > 0.5 > reflectance(CRITICAL - 5.0)
    assert (up.lengths.diff(dim=1) >= 0.0).all()
    assert float(up.points[0, -1, 2]) <= 1.0
    assert float(up.lengths.max()) > 20.0
    assert float(down.leaving[0, 2]) < 0.0
    angle = np.radians(CRITICAL - 1e-3)
    # It never leaves: this is the direction of its begin.
    np.testing.assert_allclose(up.leaving[0], [np.sin(angle), 0.0, -np.cos(angle)], atol=1e-6)


def test_points_lie_where_the_light_of_a_reflected_branch_comes_from() -> None:
    """After k reflections (R e⁻ᵗ)ᵏ of the light is left, and falls exponentially up to the next one."""
    degrees, attenuation, samples = CRITICAL - 0.2, 0.5, 50
    across = 1.0 / np.cos(np.radians(degrees))
    left = reflectance(degrees) * np.exp(-attenuation * across)
    found = seen([plate(0.0, 1.0, attenuation)], degrees, samples)
    begin = left ** np.arange(TURNS)
    light = np.concatenate([[0.0], np.cumsum(begin * -np.expm1(-attenuation * across))])
    share = (np.arange(samples) + 0.5) / samples * float(found.opacity[0])
    number = np.searchsorted(light, share) - 1
    within = -np.log1p(-(share - light[number]) / begin[number]) / attenuation
    assert number.max() >= 2
    np.testing.assert_allclose(found.lengths[0], number * across + within, rtol=1e-5, atol=1e-6)


def test_a_network_follows_as_many_branches_as_its_settings_say() -> None:
    view = ViewPath([plate(0.0, 1.0, 1.0)], 3, 64, 5)
    interior = Interior(np.full((1, 2, 2, 2), LEVELS, np.int8), (-1.0, -1.0, -1.0), 3.0, (1.0,), ETA)
    settings = replace(PRESETS["measured"], branches=5, ray_samples=3, shape_places=2, material_parts=3)
    path = path_through(plate(0.0, 1.0, 1.0), interior, settings)
    assert path.__reduce__()[1][1:] == view.__reduce__()[1][1:]


def test_many_branches_end() -> None:
    """A dozen plates with gaps between them split a steep ray at every face."""
    tops = np.linspace(1.0, -6.0, 12)
    stack = [plate(top - 0.3, top, 0.05) for top in tops]
    positions = np.concatenate([part.positions for part in stack])
    faces = np.concatenate([part.faces + 8 * n for n, part in enumerate(stack)])
    body = stack[0]._replace(positions=positions, faces=faces)
    opacities = [float(seen([body], CRITICAL - 2.0, branches=branches).opacity[0]) for branches in (2, 4, 16, 100)]
    assert np.isfinite(opacities).all()
    assert np.all(np.diff(opacities) >= 0.0)
    assert opacities[-1] <= 1.0
    assert opacities[0] < opacities[-1]
