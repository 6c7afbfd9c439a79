"""Tests of view rays with total internal reflections."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from formats.errors import ModelError
from prt_bake.network.bssrdf import PRESETS, NetworkSettings
from prt_bake.network.features.interior import LEVELS, REACH, Interior
from prt_bake.network.features.view_features import ViewFeatures
from prt_bake.network.features.view_ray import Ray, normals, trace
from prt_bake.trainer.train import train
from tests.shapes import ball
from tests.tracer.scenes import make_scene
from tests.trainer import small_training

REFLECTING = replace(
    PRESETS["measured"], features=20, width=16, light_features=4, lobes=0, shape_places=0, grid_places=0, light_places=0
)
SPACING = 0.02
RNG = np.random.default_rng(4)


def cube(attenuation: float = 0.0, eta: float = 1.5, inner: bool = False) -> Interior:
    """The unit cube in a larger grid; with `inner`, it contains a dense slab from z = 0.4 to 0.6."""
    at = -0.1 + SPACING * np.arange(61)
    x, y, z = np.meshgrid(at, at, at, indexing="ij")
    depths = [np.minimum.reduce([x, 1 - x, y, 1 - y, z, 1 - z])]
    depths += [np.minimum(z - 0.4, 0.6 - z)] if inner else []
    levels = np.clip(np.rint(np.stack(depths) * (LEVELS / (REACH * SPACING))), -LEVELS, LEVELS).astype(np.int8)
    return Interior(levels, (-0.1, -0.1, -0.1), SPACING, (attenuation, 1e3)[: len(depths)], eta)


def view_of(interior: Interior, chosen: NetworkSettings = REFLECTING, torch_only: bool = False) -> ViewFeatures:
    frequencies = torch.from_numpy(np.random.default_rng(5).normal(size=(chosen.features, 6)))
    view = ViewFeatures(chosen, frequencies, interior)
    view.torch_only = torch_only
    return view


def rays(view: ViewFeatures, x: NDArray[np.float64], towards: NDArray[np.float64]) -> Ray:
    return view._ray(torch.from_numpy(x).float(), torch.from_numpy(-towards).float())


def mirrored(x: NDArray[np.float64], towards: NDArray[np.float64], lengths: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points of rays in a unit cube of mirrors: straight lines in unfolded space."""
    straight = x[:, None] + lengths[:, None] * towards[:, None]
    return np.asarray(np.abs((straight + 1.0) % 2.0 - 1.0))


def trapped(count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points on the cube's top, and directions that meet all six walls beyond the critical angle of 41.8°."""
    towards = RNG.uniform(0.45, 0.7, (count, 3)) * RNG.choice([-1.0, 1.0], (count, 3))
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    towards[:, 2] = -np.abs(towards[:, 2])
    x = RNG.uniform(0.1, 0.9, (count, 3))
    x[:, 2] = 1.0
    assert np.abs(towards).max() < np.cos(np.arcsin(1.0 / 1.5))
    return x, towards


@pytest.mark.parametrize("torch_only", [False, True])
def test_a_trapped_ray_is_reflected_as_by_mirrors(torch_only: bool) -> None:
    x, towards = trapped(60)
    ray = rays(view_of(cube(), torch_only=torch_only), x, towards)
    lengths = np.linspace(0.05, 2.9, 40)
    found = ray.points(torch.from_numpy(lengths).float()).numpy()
    exact = mirrored(x, towards, lengths)
    # Four reflections are followed. At an edge the grid's normal is that of a bevel.
    reached = lengths < ray.begins[:, -1:].numpy()
    error = np.linalg.norm(found - exact, axis=-1)
    assert np.median(error[reached]) < 0.2 * SPACING
    assert np.mean(error[reached] < SPACING) > 0.9
    assert float((ray.begins[:, 2] < 3.0).float().mean()) > 0.9


@pytest.mark.parametrize("torch_only", [False, True])
def test_a_ray_that_leaves_goes_straight_on(torch_only: bool) -> None:
    """Within the critical angle, and at all angles if the index inside is lower."""
    x, towards = np.array([[0.5, 0.5, 1.0], [0.3, 0.6, 1.0]]), np.array([[0.0, 0.0, -1.0], [0.3, 0.2, -0.933]])
    oblique, directions = trapped(20)
    for interior, starts, along in ((cube(), x, towards), (cube(eta=0.7), oblique, directions)):
        ray = rays(view_of(interior, torch_only=torch_only), starts, along)
        assert bool(ray.begins[:, 1:].isinf().all())
        found = ray.points(torch.tensor([0.4, 2.0])).numpy()
        np.testing.assert_allclose(found, starts[:, None] + np.array([[0.4], [2.0]]) * along[:, None], atol=1e-5)


@pytest.mark.parametrize("torch_only", [False, True])
def test_a_ray_that_starts_outside_the_grids_boundary_enters_first(torch_only: bool) -> None:
    """Grids are coarse: a point on the surface may be nearly a spacing outside their boundary."""
    x, towards = trapped(60)
    x[:, 2] += 0.8 * SPACING
    ray = rays(view_of(cube(), torch_only=torch_only), x, towards)
    assert float((ray.begins[:, 2] < 3.0).float().mean()) > 0.9


def test_lengths_are_those_of_the_path() -> None:
    x, towards = trapped(60)
    ray = rays(view_of(cube()), x, towards)
    lengths = torch.linspace(0.0, 2.9, 400)
    steps = torch.diff(ray.points(lengths), dim=1).norm(dim=-1)
    assert float(steps.max()) <= 2.9 / 399 + 1e-5
    assert float(steps.median()) == pytest.approx(2.9 / 399, abs=1e-5)


def test_torch_and_compiled_rays_agree() -> None:
    x, towards = trapped(300)
    compiled, by_torch = (rays(view_of(cube(), torch_only=torch_only), x, towards) for torch_only in (False, True))
    lengths = torch.linspace(0.0, 2.9, 50)
    difference = (compiled.points(lengths) - by_torch.points(lengths)).norm(dim=-1)
    assert float(torch.mean((difference < 1e-3).float())) > 0.98  # at an edge rounding decides


def test_torch_and_compiled_features_with_reflections_agree() -> None:
    outside = np.concatenate([RNG.uniform(0.1, 0.9, (50, 2)), np.ones((50, 1))], axis=1)
    eye = np.stack([RNG.normal(size=50), RNG.normal(size=50), RNG.uniform(0.05, 1.0, 50)], axis=1)
    eye /= np.linalg.norm(eye, axis=1, keepdims=True)
    found = [
        view_of(cube(0.5, inner=True), torch_only=torch_only)(torch.from_numpy(outside), torch.from_numpy(eye))
        for torch_only in (False, True)
    ]
    assert float(((found[0] - found[1]).abs().amax(dim=1) < 1e-3).float().mean()) > 0.95


def test_a_reflected_view_sees_the_object_in_the_mirror() -> None:
    """A view that meets a wall first sees the slab in it: light comes from the slab, not from behind the wall."""
    eye = np.array([[0.9, 0.0, np.sqrt(1.0 - 0.81)]])
    x = np.array([[0.15, 0.5, 1.0]])
    normal = torch.tensor([[0.0, 0.0, 1.0]])
    view = view_of(cube(inner=True))
    lengths = view(torch.from_numpy(x), torch.from_numpy(eye), normal)[0, -13:-1].numpy() * 3.0 / 2.0
    inner = np.sqrt(1.0 - 0.81 / 1.5**2)
    np.testing.assert_allclose(lengths * inner, 0.4, atol=0.06)  # within an interval of the slab's top
    straight = view_of(cube(inner=True), replace(REFLECTING, ray_turns=0))
    assert 0.15 - 0.4 / inner * 0.6 < 0.0  # behind the wall without a reflection
    behind = straight(torch.from_numpy(x), torch.from_numpy(eye), normal)
    ahead = view(torch.from_numpy(x), torch.from_numpy(eye), normal)
    assert float((behind[:, :20] - ahead[:, :20]).abs().max()) > 0.05


def test_normals_of_a_wall_are_exact() -> None:
    view = view_of(cube())
    found = normals(lambda points: view._inside(0, points), SPACING, torch.tensor([[0.5, 0.5, 1.0], [0.0, 0.5, 0.5]]))
    np.testing.assert_allclose(found.numpy(), [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]], atol=1e-6)


@pytest.mark.parametrize("value", [1.0, 0.0, -1.0])
def test_rays_without_a_boundary_end(value: float) -> None:
    ray = trace(lambda points: torch.full(points.shape[:2], value), 0.1, 1.5, 3, 2.0, *torch.eye(3)[:2, None])
    assert bool(ray.begins[:, 1:].isinf().all())


def test_negative_reflections_are_refused() -> None:
    with pytest.raises(ModelError, match="ray_samples and ray_turns must not be negative"):
        replace(REFLECTING, ray_turns=-1)


@pytest.mark.statistics
@pytest.mark.parametrize(
    ("eta", "sigma_t", "phase_g", "turns"),
    [(1.0, 0.5, 0.0, 0), (1.4, 0.5, 0.0, 4), (1.4, 1.9, 0.0, 4), (1.4, 2.1, 0.0, 0), (1.4, 3.0, 0.5, 4)],
)
def test_training_uses_reflections_for_clear_refracting_objects(
    tmp_path: Path, eta: float, sigma_t: float, phase_g: float, turns: int
) -> None:
    """A ball of diameter 2 and albedo 0.9 is clear up to an optical depth of 4, without forward scattering."""
    scene = make_scene(tmp_path, ball(3), eta=eta, sigma_t=sigma_t, phase_g=phase_g, albedo=0.9)
    network = train(
        scene,
        steps=1,
        synchronous=True,
        settings=REFLECTING,
        stream=small_training.STREAM,
        learning=small_training.LEARNING,
    )
    assert network.settings.ray_turns == turns
