"""The self-test fails for every reader that is off by one, or that misses a rule of the interpolation."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

import prt_bake as prt
from bakers.baker import Block
from formats.asset import Asset
from prt_bake.baking.compress import without_lobes
from prt_bake.baking.output.selftest import selftest, selftest_vertices, selftest_views
from prt_bake.baking.output.sink import asset_head, open_sink
from prt_bake.shading.selftest import lobes_error, selftest_error, selftest_fault
from tests.baking.lobes.transports import Lobed, bent, mirrored
from tests.baking.prunable_scenes import Grey
from tests.shapes import ball

Array = NDArray[np.float64]
TOLERANCE = 1e-3
"""Of the page of the asset file."""


@dataclass(frozen=True)
class Reader:
    """A reader of assets as of a program in C, whose every field is a fault."""

    vertex: int = 0
    frame: int = 0
    bin: int = 0
    ring: int = 0
    sector: int = 0
    harmonic: int = 0
    channel: int = 0
    stride: int = 0
    block: int = 0
    half_ring: float = 0.5
    half_sector: float = 0.5
    handedness: float = 1.0
    floor: Callable[[Array], Array] = np.floor
    arctangent: Callable[[Array, Array], Array] = np.arctan2
    wraps: bool = True
    has_pole: bool = True
    clamps: bool = True
    below: bool = True
    harmonics_last: bool = False
    bins_swapped: bool = False

    def read(self, asset: Asset) -> Array:
        """Radiance [S,3] of the rows of the self-test."""
        vertex, outgoing = asset.selftest["vertex"], asset.selftest["outgoing"]
        framed = (vertex + self.frame) % len(asset.tangents)
        normal, tangent = (v.astype(np.float32)[framed] for v in (asset.mesh.normals, asset.tangents))
        x, z = (np.einsum("ni,ni->n", outgoing, axis) for axis in (tangent, normal))
        y = self.handedness * np.einsum("ni,ni->n", outgoing, np.cross(normal, tangent))
        depth = (1.0 - z) * asset.rings - self.half_ring
        r = np.clip(depth, 0.0, asset.rings - 1) if self.clamps else np.maximum(depth, 0.0)
        i, j = r.astype(int), self.floor(turn := self._turn(x, y, asset.sectors)).astype(int)
        below = np.minimum(i + 1, asset.rings - 1) if self.clamps else i + 1
        a, h = r - i, turn - j
        numbers = np.asarray(asset.coefficients, np.float64)
        p = np.clip(-2.0 * depth, 0.0, 1.0) if self.has_pole else np.zeros(len(z))
        value = np.zeros((len(z), 3))
        for ring, share in ((i, 1.0 - a), (below, a)):
            for sector, part in ((j, 1.0 - h), (j + 1, h)):
                value += ((1.0 - p) * share * part)[:, None] * self._lit(asset, numbers, vertex, ring, sector)
        for sector in range(asset.sectors):
            value += (p / asset.sectors)[:, None] * self._lit(asset, numbers, vertex, 0 * i, sector + 0 * i)
        return value if self.below else value * (z > 0.0)[:, None]

    def _turn(self, x: Array, y: Array, sectors: int) -> Array:
        return np.asarray(self.arctangent(y, x) / (2.0 * np.pi) * sectors - self.half_sector)

    def _lit(self, asset: Asset, numbers: Array, vertex: Any, ring: Any, sector: Any) -> Array:
        """Σ_k coefficients · light [S,3] at one bin, read from the numbers as they lie in the file."""
        _, bins, terms, channels = numbers.shape
        sector = (sector + self.sector) % asset.sectors if self.wraps else sector + self.sector
        ring = ring + self.ring
        place = asset.rings * sector + ring if self.bins_swapped else asset.sectors * ring + sector
        place = np.zeros_like(place) if bins == 1 else place + self.bin
        vertex = vertex.astype(int) + self.vertex
        start = (vertex + vertex // self.block if self.block else vertex) * (bins * terms * channels + self.stride)
        light = asset.selftest["light"] if asset.quantity == "transfer" else np.ones((1, 3))
        value = np.zeros((len(vertex), 3))
        for k in range(terms):
            for c in range(3):
                channel = (c + self.channel) % 3 if channels == 3 else 0
                term = (k + self.harmonic) % terms
                offset = channel * terms + term if self.harmonics_last else term * channels + channel
                value[:, c] += light[k, c] * numbers.take(start + place * terms * channels + offset, mode="wrap")
        return value


OF_VERTICES = {
    "vertex": Reader(vertex=1),
    "vertex before": Reader(vertex=-1),
    "vertex stride": Reader(stride=1),
    "blocks of vertices": Reader(block=8),
}
OF_VIEWS = {
    "frame of the next vertex": Reader(frame=1),
    "bin": Reader(bin=1),
    "bin before": Reader(bin=-1),
    "ring": Reader(ring=1),
    "ring before": Reader(ring=-1),
    "sector": Reader(sector=1),
    "sector before": Reader(sector=-1),
    "half a ring": Reader(half_ring=0.0),
    "half a sector": Reader(half_sector=0.0),
    "rings and sectors swapped": Reader(bins_swapped=True),
    "handedness": Reader(handedness=-1.0),
    "truncated": Reader(floor=np.trunc),
    "no interpolation": Reader(floor=np.round),
    "φ of half the circle": Reader(arctangent=lambda y, x: np.arctan(y / np.where(x == 0.0, 1.0, x))),
    "not wrapped": Reader(wraps=False),
    "not wrapped, φ from 0": Reader(wraps=False, arctangent=lambda y, x: np.arctan2(y, x) % (2.0 * np.pi)),
    "no pole": Reader(has_pole=False),
    "not clamped": Reader(clamps=False),
    "black below the horizon": Reader(below=False),
}
OF_HARMONICS = {
    "harmonic": Reader(harmonic=1),
    "harmonic before": Reader(harmonic=-1),
    "harmonics last": Reader(harmonics_last=True),
}
OF_CHANNELS = {"channel": Reader(channel=1), "channel before": Reader(channel=-1)}

COLOURED = Lobed(((mirrored, 3.0, 1.0), (bent, 6.0, 1.0)))
LIGHT = np.random.default_rng(1).normal(size=(9, 3)) + [[3.0, 2.0, 1.0]] * 9
ALL = OF_VERTICES | OF_VIEWS | OF_HARMONICS | OF_CHANNELS
BINS = {"rings": 4, "sectors": 16}


def without(readers: dict[str, Reader], *names: str) -> dict[str, Reader]:
    """The readers that are wrong, although these are right."""
    return {name: reader for name, reader in readers.items() if name not in names}


ASSETS: dict[str, tuple[Any, dict[str, Any], dict[str, Reader]]] = {
    "16 × 64 bins": (COLOURED, {"rings": 16, "sectors": 64}, ALL),
    "4 × 8 bins": (COLOURED, {"rings": 4, "sectors": 8}, ALL),
    "1 × 4 bins": (COLOURED, {"rings": 1, "sectors": 4}, without(ALL, "rings and sectors swapped")),
    "degree 1": (COLOURED, BINS | {"degree": 1}, ALL),
    "one light": (COLOURED, BINS | {"for_light": LIGHT}, OF_VERTICES | OF_VIEWS | OF_CHANNELS),
    "one view": (Grey(), BINS | {"leave_out": ("views",)}, OF_VERTICES | OF_HARMONICS),
    "one channel": (Grey(), BINS | {"leave_out": ("channels",)}, without(OF_VERTICES | OF_HARMONICS, "harmonics last")),
}
"""Name: transport, options of the bake, and the readers that must fail."""


@pytest.mark.parametrize("name", ASSETS)
def test_every_wrong_reader_fails(tmp_path: Path, name: str) -> None:
    transport, options, readers = ASSETS[name]
    asset = prt.bake(transport, ball(1), samples=32, lobes=0, out=tmp_path / "a.h5", **options)
    largest = np.abs(asset.selftest["radiance"]).max()

    def off(reader: Reader) -> float:
        return float(np.abs(reader.read(asset) - asset.selftest["radiance"]).max() / largest)

    assert off(Reader()) < 1e-6
    assert [fault for fault, reader in readers.items() if off(reader) <= TOLERANCE] == []
    asset.close()


@pytest.mark.parametrize("baked", [[7], [3, 17], [2, 3, 5, 11, 12]])
@pytest.mark.parametrize("in_memory", [False, True])
def test_rows_are_of_baked_vertices_alone(tmp_path: Path, baked: list[int], in_memory: bool) -> None:
    valid = np.isin(np.arange(18), baked)
    coefficients = np.random.default_rng(1).normal(size=(18, 4, 4, 3)).astype(np.float32)
    mesh = ball(1)
    head = asset_head(mesh, prt.sphere.tangent_frame(mesh.normals), 1, 4, 1, COLOURED)
    with open_sink(None if in_memory else tmp_path / "a.h5", head, "float32") as sink:
        sink.write(Block(0, coefficients, np.full((18, 4), 0.1, np.float32), valid, 0))
        asset = sink.finish({}, np.zeros((0, 3)), complete=False)
    expected = [baked[0], baked[len(baked) // 2], baked[-1]]
    assert sorted(set(asset.selftest["vertex"].tolist())) == sorted(set(expected))
    assert len(asset.selftest["vertex"]) == 11 * len(set(expected))
    assert selftest_error(asset) < 1e-6
    asset.close()


def test_a_bake_without_vertices_has_no_rows() -> None:
    asset = prt.bake(COLOURED, ball(1), degree=1, rings=1, sectors=4, samples=8, lobes=0)
    assert selftest(asset, selftest_vertices(np.zeros(18)), asset.coefficients[:0], None) == {}


def test_an_older_file_with_rows_of_one_vertex_is_read(tmp_path: Path) -> None:
    asset = prt.bake(COLOURED, ball(1), rings=4, sectors=8, samples=32, lobes=0)
    rows = {name: values if name == "light" else values[:6] for name, values in asset.selftest.items()}
    prt.write_asset(replace(asset, selftest=rows), tmp_path / "older.h5")
    older = prt.read_asset(tmp_path / "older.h5")
    assert set(older.selftest["vertex"]) == {0}
    assert selftest_error(older) < 1e-3


@pytest.mark.parametrize(("rings", "sectors"), [(1, 4), (4, 8), (16, 64)])
def test_views_are_where_readers_go_wrong(rings: int, sectors: int) -> None:
    views = selftest_views(rings, sectors)
    np.testing.assert_allclose(np.linalg.norm(views, axis=1), 1.0, atol=1e-15)
    at = prt.sphere.bin_coordinates(views, rings, sectors)
    assert at.pole_weight[4] == 1.0
    assert 0.4 < at.pole_weight[5] < 0.6
    assert set(at.sector_low[6:10]) == {sectors - 1}
    assert set(at.sector_high[6:10]) == {0}
    assert set(at.ring_low[8:]) == {rings - 1}
    assert views[10, 2] < 0.0
    assert not at.pole_weight[6:].any()


def test_rows_of_lobes_are_checked(tmp_path: Path) -> None:
    asset = prt.bake(Lobed(), ball(1), rings=8, sectors=16, lobes=4, out=tmp_path / "a.h5")
    assert np.abs(asset.selftest["lobes"]).max() > 0.01
    assert lobes_error(prt.read_asset(tmp_path / "a.h5")) < 1e-6
    asset.close()
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        file["lobes/powers"][...] = file["lobes/powers"][...] * 1.01
    assert "/selftest: lobes there differ from /lobes by" in str(selftest_fault(prt.read_asset(tmp_path / "a.h5")))


def test_compression_keeps_rows_of_lobes_in_step(tmp_path: Path) -> None:
    asset = prt.bake(Lobed(), ball(1), rings=8, sectors=16, lobes=4)
    prt.write_asset(prt.compress(asset, 0.02), tmp_path / "compact.h5")
    compact = prt.read_asset(tmp_path / "compact.h5")
    assert not np.array_equal(compact.selftest["lobes"], asset.selftest["lobes"])
    assert lobes_error(compact) < 1e-3
    assert set(without_lobes(asset).selftest) == {"light", "vertex", "outgoing", "radiance"}
