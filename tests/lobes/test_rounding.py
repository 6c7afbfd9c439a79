"""Lobes rounded to few digits: how much they change, and how much smaller their files are."""

import zlib
from dataclasses import replace

import numpy as np
import pytest

from formats.asset.lobes import Lobes
from prt_bake.lobes import rounding
from prt_bake.lobes.gaussians import inner_product
from prt_bake.lobes.rounding import change, rounded
from prt_bake.mathematics.directions import fibonacci, uniform

TOWARDS = fibonacci(60_000)


def lobes(scale: float = 1.0, seed: int = 0) -> Lobes:
    draw = np.random.default_rng(seed)
    shape = 20, 6, 2
    axes = uniform(int(np.prod(shape)), seed).reshape(*shape, 3).astype(np.float32)
    powers = (scale * draw.normal(size=(*shape, 3)) * draw.exponential(size=(*shape, 1))).astype(np.float32)
    powers[3:5] = 0.0
    return Lobes(2, 3, axes, np.exp(draw.uniform(1.0, 4.0, shape)).astype(np.float32), powers)


def values(some: Lobes) -> np.ndarray:
    """Each lobe's values [V,N,J,D,3] on a coarser lattice, in float64."""
    towards = fibonacci(10_000)
    sharpness = some.sharpness.astype(np.float64)[..., None]
    axes = some.axes / np.linalg.norm(some.axes, axis=-1, keepdims=True)
    shape = np.exp(sharpness * (axes.astype(np.float64) @ towards.T - 1.0))
    peak = sharpness / (2.0 * np.pi * -np.expm1(-2.0 * sharpness))
    return (peak * shape)[..., None] * some.powers.astype(np.float64)[..., None, :]


@pytest.mark.parametrize(
    ("first", "second", "turn"),
    [(9.0, 9.0, 0.0), (5.0, 80.0, 0.3), (300.0, 2.0, 2.0), (4.0, 4.0, np.pi), (1e-3, 1e-3, np.pi), (1e-3, 50.0, 1.0)],
)
def test_inner_products_are_those_of_a_lattice(first: float, second: float, turn: float) -> None:
    axes = np.array([[0.0, 0.0, 1.0], [np.sin(turn), 0.0, np.cos(turn)]])
    gaussians = [
        k / (2.0 * np.pi * -np.expm1(-2.0 * k)) * np.exp(k * (TOWARDS @ axis - 1.0))
        for k, axis in zip((first, second), axes, strict=True)
    ]
    expected = (gaussians[0] * gaussians[1]).mean() * 4.0 * np.pi
    assert inner_product(axes[0], first, axes[1], second) == pytest.approx(expected, rel=1e-3, abs=1e-12)


def test_the_change_is_the_norm_of_what_differs() -> None:
    some = lobes()
    other, changed = rounded(some, 1.0)
    expected = np.sqrt(np.square(values(some) - values(other)).mean(axis=3).sum() * 4.0 * np.pi)
    assert changed == pytest.approx(expected, rel=1e-3)
    assert changed == change(some, other)
    assert change(some, some) <= 1e-6 * change(some, replace(some, powers=0.0 * some.powers))


@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e30])
def test_fewer_digits_change_lobes_by_at_most_what_is_allowed(scale: float) -> None:
    some = lobes(scale)
    whole = change(some, replace(some, powers=0.0 * some.powers))
    sizes = []
    for share in (1e-3, 1e-2, 1e-1, 0.5):
        coarse, changed = rounded(some, share * whole)
        assert 0.2 * share * whole < changed <= share * whole
        stored = [(coarse.powers / scale).astype(np.float16), coarse.axes.astype(np.float16)]
        sizes.append(sum(len(zlib.compress(part.tobytes())) for part in stored))
        length = np.linalg.norm(coarse.axes, axis=-1)
        assert 0.75 < length.min() <= length.max() < 1.25
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[-1] < 0.5 * sizes[0]


def test_lobes_of_no_power_stay_so() -> None:
    some = lobes(0.0)
    coarse, changed = rounded(some, 0.0)
    assert changed == 0.0
    assert not coarse.powers.any()
    np.testing.assert_array_equal(coarse.axes[..., 2], 1.0)


def test_blocks_of_vertices_add_up(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = change(lobes(), lobes(seed=1))
    monkeypatch.setattr(rounding, "_AT_ONCE", 7)
    assert change(lobes(), lobes(seed=1)) == pytest.approx(whole, rel=1e-12)
