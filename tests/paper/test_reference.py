"""References resume to the same numbers, can be extended, and estimate their noise from half buffers."""

import math
from pathlib import Path

import numpy as np
import pytest

from prt_bake.lights.lighting import as_lighting
from prt_bake.paper.artefacts import Artefacts, Stopped
from prt_bake.paper.reference import Reference, reference, trace_scene
from prt_bake.rendering.half_buffers import HalfBuffers
from prt_bake.rendering.loop import Rendering
from tests.rendering.pictures import WHITE, front, make_scene

SIZE = 24
SIGMA = 0.4
"""Standard deviation of one path."""


def picture(spp: int, seed: int, complete: bool = True) -> Rendering:
    """Return a synthetic picture of radiance 1: the mean of `spp` / 2 passes of two paths."""
    passes = spp // 2
    draws = 1.0 + SIGMA / math.sqrt(2.0) * np.random.default_rng(seed).standard_normal((passes, SIZE, SIZE, 3))
    error = draws.std(axis=0, ddof=1) / math.sqrt(passes)
    parts = draws.mean(axis=0).astype(np.float32), error.astype(np.float32), np.ones((SIZE, SIZE), np.float32)
    return Rendering(*parts, 10 * spp, 60.0, spp, passes, complete, np.zeros((0, 3)))


class Tracer:
    """Counts the requested pictures, and stops at number `last`."""

    def __init__(self, last: int = 1000) -> None:
        self.seeds, self.last = list[int](), last

    def __call__(self, spp: int, seed: int, checkpoint: Path) -> Rendering:
        checkpoint.write_bytes(b"checkpoint")
        if len(self.seeds) == self.last:
            return picture(spp, seed, complete=False)
        self.seeds.append(seed)
        return picture(spp, seed)


def make(folder: Path, tracer: Tracer, spp: int | None = 64, minutes: float | None = None, seed: int = 0) -> Reference:
    artefacts = Artefacts(folder, lambda sentence: None)
    return reference(artefacts, "a/reference.exr", {"seed": seed}, SIZE, tracer, spp, minutes)


def test_a_stopped_reference_resumes_to_the_same_numbers(tmp_path: Path) -> None:
    uninterrupted = make(tmp_path / "uninterrupted", Tracer())
    first, second = Tracer(last=3), Tracer()
    with pytest.raises(Stopped, match="stopped after 48 paths"):
        make(tmp_path / "parts", first)
    parts = make(tmp_path / "parts", second)
    assert (len(first.seeds), len(second.seeds)) == (3, 1)
    assert len({*first.seeds, *second.seeds}) == 4
    for name in ("image", "standard_error", "noise", "coverage"):
        np.testing.assert_array_equal(getattr(parts, name), getattr(uninterrupted, name))
    assert not list((tmp_path / "parts").rglob("*.render.npz"))
    assert parts.artefact.facts == uninterrupted.artefact.facts == {"spp": 64, "walks": 640, "seconds": 240.0}


def test_a_larger_goal_extends_the_reference(tmp_path: Path) -> None:
    make(tmp_path, Tracer())
    again, more, fewer, other = Tracer(), Tracer(), Tracer(), Tracer()
    make(tmp_path, again)
    deeper = make(tmp_path, more, spp=96)
    kept = make(tmp_path, fewer, spp=16)
    make(tmp_path, other, seed=1)
    assert [len(tracer.seeds) for tracer in (again, more, fewer, other)] == [0, 2, 0, 4]
    assert kept.artefact.facts["spp"] == deeper.artefact.facts["spp"] == 96


def test_the_time_limit_ends_after_both_half_buffers_have_paths(tmp_path: Path) -> None:
    assert make(tmp_path / "none", Tracer(), spp=None, minutes=0.0).artefact.facts["spp"] == 32
    assert make(tmp_path / "some", Tracer(), spp=None, minutes=2.5).artefact.facts["seconds"] == 180.0


def test_damaged_sums_are_discarded(tmp_path: Path) -> None:
    make(tmp_path, Tracer())
    (tmp_path / "a/reference.sums.npz").write_bytes(b"nothing")
    tracer = Tracer()
    make(tmp_path, tracer)
    assert len(tracer.seeds) == 4


@pytest.mark.parametrize("spps", [(16, 16), (64, 16, 16), (16, 16, 16)])
def test_the_noise_of_the_half_buffers_has_the_variance_of_the_error_and_is_uncorrelated(spps: tuple[int, ...]) -> None:
    halves = HalfBuffers.empty(SIZE)
    for seed, spp in enumerate(spps):
        halves.add(picture(spp, seed))
    error, noise = (halves.image - 1.0).ravel(), halves.noise.ravel()
    expected = SIGMA**2 / sum(spps)
    # 1728 normal numbers: their mean square is within 5 sqrt(2/1728) = 0.17 but once in two million.
    assert np.mean(error**2) == pytest.approx(expected, rel=0.17)
    assert np.mean(noise**2) == pytest.approx(expected, rel=0.17)
    assert abs(np.mean(error * noise)) < 5.0 * expected / math.sqrt(len(noise))
    # Each picture's variance is known from 7 or more degrees of freedom, 1728 times over.
    assert np.mean(halves.standard_error**2) == pytest.approx(expected, rel=0.1)


def test_references_contain_no_unscattered_light(tmp_path: Path) -> None:
    """Clear glass in a white furnace has unscattered light only."""
    glass = make_scene(tmp_path, eta=1.4, sigma_t=1e-6)
    trace = trace_scene(glass, as_lighting(WHITE, "y", 0.0), front(size=8), lambda: False, lambda share: None)
    seen = trace(16, 1, tmp_path / "glass.npz")
    assert seen.coverage.max() == 1.0
    assert seen.image.max() < 1e-3
