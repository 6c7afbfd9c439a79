"""Lobes that are added to assets."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import prt_bake as prt
from formats.asset import check_asset
from formats.errors import InputWarning, QueryError
from tests.baking.lobes.transports import MESH, Lobed, Smooth, errors, mirrored, towards


def test_a_lobe_is_found() -> None:
    asset = prt.add_lobes(prt.bake(Lobed(), MESH, rings=16, sectors=32), Lobed())
    assert asset.lobes is not None
    entry = asset.provenance["lobes"]
    assert entry["left_by_lobes"][-1] <= 0.15 * entry["beyond_harmonics"]
    without, found = errors(Lobed(), asset, towards(0.6))
    assert found <= 0.4 * without


def test_nothing_is_found_where_harmonics_suffice() -> None:
    asset = prt.add_lobes(prt.bake(Smooth(), MESH, rings=2, sectors=8), Smooth())
    assert asset.lobes is None
    assert asset.provenance["lobes"]["beyond_harmonics"] <= 1e-5


def test_at_most_as_many_as_requested() -> None:
    asset = prt.bake(Lobed(), MESH, rings=2, sectors=8)
    for most in (-1, 0, 5):
        with pytest.raises(QueryError, match=f"most: expected 1 to 4 lobes in a view, found {most}"):
            prt.add_lobes(asset, Lobed(), most)
    one = prt.add_lobes(asset, Lobed(), 1).lobes
    assert one is not None
    assert one.count == 1


def test_lobes_do_not_depend_on_the_workers() -> None:
    asset = prt.bake(Lobed(), MESH, rings=2, sectors=8)
    one, four = (prt.add_lobes(asset, Lobed(), workers=workers).lobes for workers in (1, 4))
    assert one is not None
    assert four is not None
    assert all(np.array_equal(getattr(one, name), getattr(four, name)) for name in ("axes", "sharpness", "powers"))


def test_lobes_are_stored(tmp_path: Path) -> None:
    asset = prt.bake(Lobed(), MESH, rings=2, sectors=8, lobes=4)
    prt.write_asset(asset, path := tmp_path / "lobed.h5")
    assert check_asset(path) == []
    stored = prt.read_asset(path).lobes
    assert asset.lobes is not None
    assert stored is not None
    assert np.allclose(stored.axes, asset.lobes.axes, atol=1e-3)
    assert np.allclose(stored.powers, asset.lobes.powers, rtol=1e-3, atol=1e-6)


def test_vertices_that_are_not_finite_have_no_lobes() -> None:
    class Broken(Lobed):
        def evaluate(self, incident: Any, positions: Any, outgoing: Any) -> np.ndarray:
            values = super().evaluate(incident, positions, outgoing)
            values[np.asarray(positions)[:, 1] > 0.9] = np.nan
            return values

    asset = prt.bake(Broken(), MESH, rings=2, sectors=8, lobes=4)
    assert asset.lobes is not None
    assert not asset.valid.all()
    assert not asset.lobes.powers[~asset.valid].any()
    assert asset.lobes.powers[asset.valid].any(axis=(1, 2, 3)).all()


def test_walks_are_refused() -> None:
    class Walks:
        def estimate_coefficients(self, *_: Any) -> Any: ...

    with pytest.raises(QueryError, match="expected one that evaluates Ŝ"):
        prt.add_lobes(prt.bake(Smooth(), MESH, rings=1, sectors=4), Walks())


def test_assets_made_for_one_light_or_eye_are_refused() -> None:
    asset = prt.bake(Lobed(), MESH, rings=1, sectors=4)
    eye = prt.bake(Lobed(), MESH, rings=1, sectors=4, lobes=4, for_eye=[0.0, 0.0, 5.0])
    assert eye.lobes is None
    for made in (replace(asset, quantity="radiance"), eye):
        with pytest.raises(QueryError, match="made for one light or one camera position"):
            prt.add_lobes(made, Lobed())


def test_a_transport_of_another_material_is_reported() -> None:
    asset = prt.bake(Lobed(), MESH, rings=2, sectors=8)
    assert prt.add_lobes(asset, Lobed(), 1).provenance["lobes"]["harmonics_apart"] <= 0.1
    with pytest.warns(InputWarning, match="its harmonics are [0-9]+% off the asset's coefficients"):
        other = prt.add_lobes(asset, Lobed(constant=1.0), 1)
    assert other.provenance["lobes"]["harmonics_apart"] > 1.0


def test_coefficients_of_any_layout_are_compared() -> None:
    for rings, sectors, degree in ((1, 1, 2), (4, 8, 0), (4, 8, 3)):
        asset = prt.bake(Lobed(), MESH, degree=degree, rings=rings, sectors=sectors, samples=256)
        assert prt.add_lobes(asset, Lobed(), 1).provenance["lobes"]["harmonics_apart"] <= 0.1


def test_too_few_nodes_are_the_reason_for_no_lobes() -> None:
    transport = Lobed(((mirrored, 40.0, 1.0),))
    entry = prt.add_lobes(prt.bake(transport, MESH, rings=2, sectors=4), transport).provenance["lobes"]
    assert entry["lobes_in_a_view"] == 0
    assert "at 1×1 nodes; with more view bins there are more" in entry["reason"]
