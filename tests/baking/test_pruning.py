"""What a scene does not need is left out, said, and held against every vertex; everything else stays bit for bit."""

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
import trimesh

import prt_bake
from formats.errors import QueryError
from formats.image import write_image
from formats.mesh import Mesh
from prt_bake import bake, read_asset, shade
from prt_bake.baking import bake as baking
from prt_bake.baking.pruning.hidden_vertices import seen_from_eye, seen_from_outside
from prt_bake.mathematics import sh, sphere
from tests.bakers.transports import Array, Counting, Edged, Lobed, exact, icosphere
from tests.baking.prunable_scenes import Flat, Grey, nested, soup
from tests.cli.command_line import Run

SHIPPED = Path(prt_bake.__file__).parent / "shipped"
SMALL = {"rings": 8, "sectors": 32}


def relative(off: Array, truth: Array) -> float:
    return float(np.sqrt((off**2).sum() / (truth**2).sum()))


@pytest.mark.parametrize("asked", [{"error": 0.03}, {"samples": 32}])
def test_what_no_eye_outside_sees_is_not_baked_and_the_rest_is_the_same(asked: dict[str, float]) -> None:
    mesh, inside = nested(1.0, 0.5)
    outside = int((~inside).sum())
    seen = seen_from_outside(mesh)
    assert seen[:outside].all()
    assert not seen[outside:].any()
    counted, whole_counted = Counting(Lobed()), Counting(Lobed())
    asset = bake(counted, mesh, **SMALL, **asked, leave_out=["unseen"])
    whole = bake(whole_counted, mesh, **SMALL, **asked)
    assert np.flatnonzero(asset.valid).tolist() == list(range(outside))
    assert asset.complete
    assert whole.valid.all()
    assert counted.evaluations == asset.provenance["evaluations"] < 0.8 * whole_counted.evaluations
    assert [item["item"] for item in asset.left_out] == ["unseen"]
    assert "42 of 84" in asset.left_out[0]["reason"]
    if "samples" in asked:
        np.testing.assert_array_equal(asset.coefficients[:outside], whole.coefficients[:outside])


def test_vertices_twice_in_a_mesh_are_baked_once() -> None:
    ball = trimesh.creation.icosphere(subdivisions=1)
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces).copy()
    # A seam: the first vertex stands there twice, and half of its faces have the copy.
    around = np.flatnonzero((faces == 0).any(axis=1))[::2]
    faces[around] = np.where(faces[around] == 0, len(vertices), faces[around])
    normals = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    mesh = Mesh(
        np.concatenate([vertices, vertices[:1]]), faces.astype(np.int32), np.concatenate([normals, normals[:1]])
    )
    for asked in ({"error": 0.05}, {"samples": 32}):
        asked_at: list[Array] = []

        class Asked(Lobed):
            def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
                asked_at.append(positions)  # noqa: B023
                return super().evaluate(incident, positions, outgoing)

        asset = bake(Asked(), mesh, rings=4, sectors=8, **asked, leave_out=["duplicates"])
        np.testing.assert_array_equal(asset.coefficients[0], asset.coefficients[-1])
        assert asset.valid.all()
        assert asset.left_out[0]["item"] == "duplicates"
        assert len(np.unique(np.concatenate(asked_at), axis=0)) == 42
        assert asset.provenance["vertices_baked"] == 42


def test_what_is_copied_is_seen_as_all_of_its_copies_are() -> None:
    # Every corner has a face of its own, and below that face's horizon views are bent.
    mesh = soup()
    asset = bake(Lobed(), mesh, **SMALL, error=0.03, leave_out=["duplicates"])
    truth = exact(Lobed(), mesh, 8, 32, directions=512)
    assert asset.provenance["vertices_baked"] == 42
    assert relative(asset.coefficients - truth, truth) < 0.033
    smooth = bake(Lobed(), icosphere(1), **SMALL, samples=32).provenance["bins_bent_to_the_horizon"]
    whole = bake(Lobed(), mesh, **SMALL, samples=32).provenance["bins_bent_to_the_horizon"]
    assert smooth / 42 == pytest.approx(whole / 240, rel=0.1)


@pytest.mark.parametrize("pays", [1.3, np.inf])
def test_errors_of_views_that_err_apart_are_not_those_of_their_mean(
    pays: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Over a lattice that they share, and over lattices of their own, where what they differ by is noise alone."""
    monkeypatch.setattr("prt_bake.baking.adaptive.tolerances.SHARED_PAYS", pays)
    mesh = icosphere(2)
    asset = bake(Grey(), mesh, **SMALL, error=0.01, leave_out=baking.ITEMS)
    assert [item["item"] for item in asset.left_out] == ["views", "channels"]
    truth = exact(Grey(), mesh, 8, 32, directions=1024)
    true = relative(asset.coefficients - truth, truth)
    assert 0.75 < asset.provenance["estimated_relative_rmse"]["total"] / true < 1.35


@pytest.mark.parametrize("asked", [{"error": 0.02}, {"samples": 512}])
def test_where_the_view_does_not_matter_one_is_kept(asked: dict[str, float], tmp_path: Path) -> None:
    mesh, out = icosphere(1), tmp_path / "asset.h5"
    counted = Counting(Edged())
    asset = bake(counted, mesh, **asked, leave_out=baking.ITEMS, out=out)
    truth = exact(Edged(), mesh, 16, 64)
    assert asset.coefficients.shape == (42, 1, 9, 3)
    assert relative(asset.coefficients[...] - truth, truth) < 0.022
    told = asset.provenance["estimated_relative_rmse"]["total"]
    assert 0.6 < told / relative(asset.coefficients[...] - truth, truth) < 2.0
    assert counted.evaluations == asset.provenance["evaluations"] < 42 * 1024 * 8
    with h5py.File(out) as file:
        left_out = json.loads(file.attrs["left_out"])
        assert [item["item"] for item in left_out] == ["views"]
        assert all(item["reason"] and item["saving"] and item["cost"] for item in left_out)
        assert file["transfer/coefficients"].shape == (42, 1, 9, 3)
    light = np.random.default_rng(1).uniform(size=(9, 3))
    found = shade(read_asset(out), light, [3.0, 2.0, 1.0])
    full = bake(Edged(), mesh, samples=1024, rings=4, sectors=8)
    np.testing.assert_allclose(found, shade(full, light, [3.0, 2.0, 1.0]), atol=0.05 * found.max())


@pytest.mark.parametrize("asked", [{"error": 0.05}, {"samples": 64}])
def test_channels_that_are_one_are_kept_once(asked: dict[str, float]) -> None:
    mesh = icosphere(1)
    asset = bake(Grey(), mesh, **SMALL, **asked, leave_out=["channels"])
    assert asset.coefficients.shape == (42, 256, 9, 1)
    truth = exact(Grey(), mesh, 8, 32)
    assert relative(asset.coefficients - truth, truth) < 0.055


@pytest.mark.parametrize("asked", [{"error": 0.05}, {"samples": 64}])
@pytest.mark.parametrize("item", ["views", "channels"])
def test_a_single_vertex_that_needs_more_gets_it(asked: dict[str, float], item: str, tmp_path: Path) -> None:
    mesh = icosphere(2)
    here = mesh.positions[101]
    other = Grey(coloured=here) if item == "channels" else Grey(changing=here)
    counted = Counting(other)
    asset = bake(counted, mesh, rings=4, sectors=16, **asked, leave_out=["views", "channels"], out=tmp_path / "a.h5")
    assert asset.coefficients.shape == {"views": (162, 64, 9, 1), "channels": (162, 1, 9, 3)}[item]
    assert item not in [left["item"] for left in asset.left_out]
    assert asset.provenance["needed_after_all"] == [f"{item} matter at vertex 101"]
    assert counted.evaluations == asset.provenance["evaluations"]
    truth = exact(other, mesh, 4, 16)
    assert relative((asset.coefficients[...] - truth)[101], truth[101]) < 0.1


def test_bands_that_hold_nothing_are_left_out() -> None:
    mesh = icosphere(1)
    for asked in ({"error": 0.05}, {"samples": 64}):
        asset = bake(Flat(), mesh, **SMALL, **asked, leave_out=["bands"])
        assert asset.degree == 1
        assert asset.coefficients.shape == (42, 256, 4, 3)
        assert asset.check_values.shape == (2, 4)
        truth = exact(Flat(), mesh, 8, 32, degree=1)
        assert relative(asset.coefficients - truth, truth) < 0.055
        assert bake(Flat(), mesh, **SMALL, **asked).degree == 2


def test_an_asset_for_one_light_holds_its_radiance(tmp_path: Path) -> None:
    mesh, out = icosphere(1), tmp_path / "lit.h5"
    light = np.random.default_rng(2).uniform(-0.2, 1.0, size=(9, 3))
    asset = bake(Lobed(), mesh, **SMALL, error=0.01, for_light=light, out=out)
    full = bake(Lobed(), mesh, **SMALL, error=0.01)
    assert asset.coefficients.shape == (42, 256, 1, 3)
    assert asset.quantity == "radiance"
    assert asset.left_out[0]["item"] == "other lights"
    expected = np.einsum("vbkc,kc->vbc", exact(Lobed(), mesh, 8, 32), light)
    assert relative(asset.coefficients[:, :, 0] - expected, expected) < 0.02
    eye = [2.0, 1.0, 3.0]
    np.testing.assert_allclose(shade(read_asset(out), None, eye), shade(full, light, eye), atol=0.05)


def test_a_light_without_higher_bands_needs_none() -> None:
    light = np.zeros((9, 3))
    light[0], light[3] = 1.0, [0.5, 0.2, 0.1]
    asset = bake(Lobed(), icosphere(1), **SMALL, samples=64, for_light=light)
    assert asset.degree == 1
    assert "degree 1 of 2" in asset.left_out[0]["saving"]


def test_an_asset_for_one_eye_has_one_view_of_what_it_sees() -> None:
    mesh, eye = icosphere(2), np.array([0.5, 3.0, 1.0])
    counted = Counting(Lobed())
    asset = bake(counted, mesh, error=0.02, for_eye=eye)
    assert asset.coefficients.shape == (162, 1, 9, 3)
    facing = (mesh.positions @ eye) > 1.0
    seen = seen_from_eye(mesh, eye)
    assert asset.valid[facing].all()
    assert 0.3 < asset.valid.mean() < 0.75
    np.testing.assert_array_equal(asset.valid, seen)
    light = np.random.default_rng(3).uniform(size=(9, 3))
    towards = eye - mesh.positions
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    incident = np.broadcast_to(sphere.fibonacci(4096), (len(towards), 4096, 3))
    y = sh.evaluate(sphere.fibonacci(4096), 2)
    a = np.linalg.solve(y.T @ y, y.T) @ Lobed().evaluate(incident, mesh.positions, towards)
    expected = np.maximum(np.einsum("vkc,kc->vc", a, light)[facing], 0.0)
    np.testing.assert_allclose(shade(asset, light, eye)[facing], expected, rtol=0.1, atol=0.02)
    assert counted.evaluations < 162 * 1024


def test_what_could_not_be_is_refused() -> None:
    mesh = icosphere(1)
    with pytest.raises(QueryError, match="found colour"):
        bake(Lobed(), mesh, leave_out=["colour"])
    with pytest.raises(QueryError, match="for_light"):
        bake(Lobed(), mesh, for_light=np.zeros((4, 3)))
    with pytest.raises(QueryError, match="for_eye"):
        bake(Lobed(), mesh, for_eye=[1.0, 2.0])
    with pytest.raises(QueryError, match="eye"):
        bake(Lobed(), mesh, for_eye=[0.0, 0.1, 0.0])


def test_the_plan_says_what_is_left_out_and_what_it_saves() -> None:
    mesh, _inside = nested(1.0, 0.5)
    plan = baking.plan(Edged(), mesh, error=0.02, leave_out=baking.ITEMS)
    assert {item.item for item in plan.left_out} == {"unseen", "views"}
    assert plan.vertices == 42
    assert plan.raw_bytes == 42 * 9 * 3 * 2
    whole = baking.plan(Edged(), mesh, error=0.02)
    assert plan.evaluations < 0.75 * whole.evaluations
    assert whole.left_out == []
    kept = baking.plan(Edged(), mesh, samples=64, leave_out=["unseen"])
    assert kept.evaluations == 42 * 1024 * 64


def test_a_plan_counts_what_the_bake_will() -> None:
    mesh = icosphere(1)
    for more in ({}, {"leave_out": ["bands"]}, {"for_eye": [0.5, 3.0, 1.0]}):
        plan = baking.plan(Lobed(), mesh, **SMALL, error=0.01, **more)
        asset = bake(Lobed(), mesh, **SMALL, error=0.01, **more)
        assert plan.evaluations == pytest.approx(asset.provenance["evaluations"], rel=0.25)


def test_of_an_asset_for_one_light_the_error_of_its_radiance_is_told() -> None:
    # Hardly any of it is in the constant: errors of coefficients say little of the radiance.
    light = np.zeros((9, 3))
    light[6] = 1.0
    asset = bake(Lobed(), icosphere(1), rings=4, sectors=16, error=0.05, for_light=light)
    truth = np.einsum("vbkc,kc->vbc", exact(Lobed(), icosphere(1), 4, 16), light)
    true = np.sqrt(((asset.coefficients[:, :, 0] - truth) ** 2).sum() / (truth**2).sum())
    assert 0.6 < asset.provenance["estimated_relative_rmse"]["total"] / true < 1.7


def test_a_picture_that_an_asset_for_one_light_cannot_show_is_told(prtbake: Run, tmp_path: Path) -> None:
    skies = [tmp_path / "one.exr", tmp_path / "other.exr"]
    for sky, value in zip(skies, (1.0, 2.0), strict=True):
        write_image(sky, np.full((8, 16, 3), value, np.float32))
    asset, eye = tmp_path / "lit.h5", ["--eye", "0,1,4"]
    made_for = ["--rings", "1", "--sectors", "4", "--samples", "32", "--for-light", skies[0], "--for-eye", "0,1,4"]
    assert prtbake("bake", SHIPPED / "spot.pt", SHIPPED / "spot.obj", "-o", asset, *made_for).code == 0
    picture = ["-o", tmp_path / "a.exr", "--size", "16x16"]
    as_made = prtbake("shade", asset, "--light", skies[0], *eye, *picture)
    assert as_made.code == 0
    assert "not under" not in as_made.err
    assert "colours are wrong" not in as_made.err
    assert "not under other.exr" in prtbake("shade", asset, "--light", skies[1], *eye, *picture).err
    turned = prtbake("shade", asset, "--light", skies[0], "--rotate", "90", "--eye", "3,0,0", *picture)
    assert "not under one.exr turned by 90 degrees" in turned.err
    assert "colours are wrong" in turned.err
