"""Pruning removes redundant parts of a bake, reports them, and checks them at every vertex."""

import inspect
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
from prt_bake.cli.bake import bake as command
from prt_bake.mathematics import sh, sphere
from tests.bakers.transports import Array, Counting, Edged, Lobed, exact, icosphere
from tests.baking.prunable_scenes import Flat, Grey, nested, soup
from tests.cli.command_line import Run

SHIPPED = Path(prt_bake.__file__).parent / "shipped"
SMALL = {"rings": 8, "sectors": 32}


def relative(difference: Array, reference: Array) -> float:
    return float(np.sqrt((difference**2).sum() / (reference**2).sum()))


def test_every_item_is_named_where_users_look() -> None:
    keep = inspect.signature(command).parameters["keep"].annotation.__metadata__[0]
    for item in baking.ITEMS:
        assert item in keep.help
        assert f'"{item}"' in str(bake.__doc__)


@pytest.mark.parametrize("arguments", [{"error": 0.03}, {"samples": 32}])
def test_hidden_vertices_are_not_baked_and_the_others_are_equal(arguments: dict[str, float]) -> None:
    mesh, inside = nested(1.0, 0.5)
    outside = int((~inside).sum())
    seen = seen_from_outside(mesh)
    assert seen[:outside].all()
    assert not seen[outside:].any()
    counted, whole_counted = Counting(Lobed()), Counting(Lobed())
    asset = bake(counted, mesh, **SMALL, **arguments, leave_out=["unseen"])
    whole = bake(whole_counted, mesh, **SMALL, **arguments)
    assert np.flatnonzero(asset.valid).tolist() == list(range(outside))
    assert asset.complete
    assert whole.valid.all()
    assert counted.evaluations == asset.provenance["evaluations"] < 0.8 * whole_counted.evaluations
    assert [item["item"] for item in asset.left_out] == ["unseen"]
    assert "42 of 84" in asset.left_out[0]["reason"]
    if "samples" in arguments:
        np.testing.assert_array_equal(asset.coefficients[:outside], whole.coefficients[:outside])


def test_duplicate_vertices_are_baked_once() -> None:
    ball = trimesh.creation.icosphere(subdivisions=1)
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces).copy()
    # A seam: the first vertex has a copy, which half of its faces use.
    around = np.flatnonzero((faces == 0).any(axis=1))[::2]
    faces[around] = np.where(faces[around] == 0, len(vertices), faces[around])
    normals = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    mesh = Mesh(
        np.concatenate([vertices, vertices[:1]]), faces.astype(np.int32), np.concatenate([normals, normals[:1]])
    )
    for arguments in ({"error": 0.05}, {"samples": 32}):
        evaluated: list[Array] = []

        class Recording(Lobed):
            def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
                evaluated.append(positions)  # noqa: B023
                return super().evaluate(incident, positions, outgoing)

        asset = bake(Recording(), mesh, rings=4, sectors=8, **arguments, leave_out=["duplicates"])
        np.testing.assert_array_equal(asset.coefficients[0], asset.coefficients[-1])
        assert asset.valid.all()
        assert asset.left_out[0]["item"] == "duplicates"
        assert len(np.unique(np.concatenate(evaluated), axis=0)) == 42
        assert asset.provenance["vertices_baked"] == 42


def test_copies_share_the_horizon_of_all_their_faces() -> None:
    # Every corner belongs to one face, and views below the horizon of that face are clamped.
    mesh = soup()
    asset = bake(Lobed(), mesh, **SMALL, error=0.03, leave_out=["duplicates"])
    truth = exact(Lobed(), mesh, 8, 32, directions=512)
    assert asset.provenance["vertices_baked"] == 42
    assert relative(asset.coefficients - truth, truth) < 0.033
    smooth = bake(Lobed(), icosphere(1), **SMALL, samples=32).provenance["bins_moved_to_the_horizon"]
    whole = bake(Lobed(), mesh, **SMALL, samples=32).provenance["bins_moved_to_the_horizon"]
    assert smooth / 42 == pytest.approx(whole / 240, rel=0.1)


@pytest.mark.parametrize("pays", [1.3, np.inf])
def test_averaging_views_reduces_their_independent_errors(pays: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a shared lattice, and with separate lattices, whose views differ by noise alone."""
    monkeypatch.setattr("prt_bake.baking.adaptive.tolerances.SHARED_PAYS", pays)
    mesh = icosphere(2)
    asset = bake(Grey(), mesh, **SMALL, error=0.01, leave_out=baking.ITEMS)
    assert [item["item"] for item in asset.left_out] == ["views", "channels"]
    truth = exact(Grey(), mesh, 8, 32, directions=1024)
    true = relative(asset.coefficients - truth, truth)
    assert 0.75 < asset.provenance["estimated_relative_rmse"]["total"] / true < 1.35


@pytest.mark.statistics
@pytest.mark.parametrize("arguments", [{"error": 0.02}, {"samples": 512}])
def test_one_view_is_kept_if_views_do_not_matter(arguments: dict[str, float], tmp_path: Path) -> None:
    mesh, out = icosphere(1), tmp_path / "asset.h5"
    counted = Counting(Edged())
    asset = bake(counted, mesh, **arguments, leave_out=baking.ITEMS, out=out)
    truth = exact(Edged(), mesh, 16, 64)
    assert asset.coefficients.shape == (42, 1, 9, 3)
    assert relative(asset.coefficients[...] - truth, truth) < 0.022
    reported = asset.provenance["estimated_relative_rmse"]["total"]
    assert 0.6 < reported / relative(asset.coefficients[...] - truth, truth) < 2.0
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


@pytest.mark.parametrize("arguments", [{"error": 0.05}, {"samples": 64}])
def test_equal_channels_are_stored_once(arguments: dict[str, float]) -> None:
    mesh = icosphere(1)
    asset = bake(Grey(), mesh, **SMALL, **arguments, leave_out=["channels"])
    assert asset.coefficients.shape == (42, 256, 9, 1)
    truth = exact(Grey(), mesh, 8, 32, directions=1024)
    assert relative(asset.coefficients - truth, truth) < 0.055


@pytest.mark.statistics
@pytest.mark.parametrize("arguments", [{"error": 0.05}, {"samples": 64}])
@pytest.mark.parametrize("item", ["views", "channels"])
def test_an_item_that_one_vertex_needs_is_not_pruned(arguments: dict[str, float], item: str, tmp_path: Path) -> None:
    mesh = icosphere(2)
    here = mesh.positions[101]
    other = Grey(coloured=here) if item == "channels" else Grey(changing=here)
    counted = Counting(other)
    asset = bake(
        counted, mesh, rings=4, sectors=16, **arguments, leave_out=["views", "channels"], out=tmp_path / "a.h5"
    )
    assert asset.coefficients.shape == {"views": (162, 64, 9, 1), "channels": (162, 1, 9, 3)}[item]
    assert item not in [left["item"] for left in asset.left_out]
    assert asset.provenance["needed_after_all"] == [f"{item} matter at vertex 101"]
    assert counted.evaluations == asset.provenance["evaluations"]
    truth = exact(other, mesh, 4, 16)
    assert relative((asset.coefficients[...] - truth)[101], truth[101]) < 0.1


@pytest.mark.statistics
def test_empty_bands_are_pruned() -> None:
    mesh = icosphere(1)
    for arguments in ({"error": 0.05}, {"samples": 64}):
        asset = bake(Flat(), mesh, **SMALL, **arguments, leave_out=["bands"])
        assert asset.degree == 1
        assert asset.coefficients.shape == (42, 256, 4, 3)
        assert asset.check_values.shape == (2, 4)
        truth = exact(Flat(), mesh, 8, 32, degree=1)
        assert relative(asset.coefficients - truth, truth) < 0.055
        assert bake(Flat(), mesh, **SMALL, **arguments).degree == 2


def test_an_asset_for_one_light_holds_radiance(tmp_path: Path) -> None:
    mesh, out = icosphere(1), tmp_path / "lit.h5"
    light = np.random.default_rng(2).uniform(-0.2, 1.0, size=(9, 3))
    asset = bake(Lobed(), mesh, **SMALL, error=0.01, for_light=light, out=out)
    full = bake(Lobed(), mesh, **SMALL, error=0.01)
    assert asset.coefficients.shape == (42, 256, 1, 3)
    assert asset.quantity == "radiance"
    assert asset.left_out[0]["item"] == "other lights"
    expected = np.einsum("vbkc,kc->vbc", exact(Lobed(), mesh, 8, 32, directions=1024), light)
    assert relative(asset.coefficients[:, :, 0] - expected, expected) < 0.02
    eye = [2.0, 1.0, 3.0]
    np.testing.assert_allclose(shade(read_asset(out), None, eye), shade(full, light, eye), atol=0.05)


def test_a_light_without_higher_bands_prunes_them() -> None:
    light = np.zeros((9, 3))
    light[0], light[3] = 1.0, [0.5, 0.2, 0.1]
    asset = bake(Lobed(), icosphere(1), **SMALL, samples=64, for_light=light)
    assert asset.degree == 1
    assert "degree 1 of 2" in asset.left_out[0]["saving"]


def test_an_asset_for_one_eye_has_one_view_of_visible_vertices() -> None:
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


def test_invalid_pruning_arguments_raise() -> None:
    mesh = icosphere(1)
    with pytest.raises(QueryError, match="found colour"):
        bake(Lobed(), mesh, leave_out=["colour"])
    with pytest.raises(QueryError, match="for_light"):
        bake(Lobed(), mesh, for_light=np.zeros((4, 3)))
    with pytest.raises(QueryError, match="for_eye"):
        bake(Lobed(), mesh, for_eye=[1.0, 2.0])
    with pytest.raises(QueryError, match="eye"):
        bake(Lobed(), mesh, for_eye=[0.0, 0.1, 0.0])


def test_the_plan_lists_pruned_items_and_their_saving() -> None:
    mesh, _inside = nested(1.0, 0.5)
    plan = baking.plan(Edged(), mesh, **SMALL, error=0.02, leave_out=baking.ITEMS)
    assert {item.item for item in plan.left_out} == {"unseen", "views"}
    assert plan.vertices == 42
    assert plan.raw_bytes == 42 * 9 * 3 * 2
    whole = baking.plan(Edged(), mesh, **SMALL, error=0.02)
    assert plan.evaluations < 0.75 * whole.evaluations
    assert whole.left_out == []
    kept = baking.plan(Edged(), mesh, **SMALL, samples=64, leave_out=["unseen"])
    assert kept.evaluations == 42 * 256 * 64


def test_the_plan_predicts_evaluations_with_pruning() -> None:
    mesh = icosphere(1)
    for more in ({}, {"leave_out": ["bands"]}, {"for_eye": [0.5, 3.0, 1.0]}):
        plan = baking.plan(Lobed(), mesh, **SMALL, error=0.01, **more)
        asset = bake(Lobed(), mesh, **SMALL, error=0.01, **more)
        assert plan.evaluations == pytest.approx(asset.provenance["evaluations"], rel=0.25)


def test_an_asset_for_one_light_reports_the_error_of_its_radiance() -> None:
    # A light without a constant term: errors of coefficients differ from those of the radiance.
    light = np.zeros((9, 3))
    light[6] = 1.0
    asset = bake(Lobed(), icosphere(1), rings=4, sectors=16, error=0.05, for_light=light)
    truth = np.einsum("vbkc,kc->vbc", exact(Lobed(), icosphere(1), 4, 16, directions=1024), light)
    true = np.sqrt(((asset.coefficients[:, :, 0] - truth) ** 2).sum() / (truth**2).sum())
    assert 0.6 < asset.provenance["estimated_relative_rmse"]["total"] / true < 1.7


@pytest.mark.statistics
def test_shading_an_asset_for_one_light_under_another_warns(prtbake: Run, tmp_path: Path) -> None:
    skies = [tmp_path / "one.exr", tmp_path / "other.exr"]
    for sky, value in zip(skies, (1.0, 2.0), strict=True):
        write_image(sky, np.full((8, 16, 3), value, np.float32))
    asset, eye = tmp_path / "lit.h5", ["--eye", "0,1,4"]
    made_for = ["--rings", "1", "--sectors", "4", "--samples", "32", "--for-light", skies[0], "--for-eye", "0,1,4"]
    assert prtbake("bake", SHIPPED / "spot.pt", SHIPPED / "spot.obj", "-o", asset, *made_for).code == 0
    picture = ["-o", tmp_path / "a.exr", "--size", "16x16"]
    as_made = prtbake("shade", asset, "--light", skies[0], *eye, *picture)
    assert as_made.code == 0
    assert "shows that light" not in as_made.err
    assert "colours are wrong" not in as_made.err
    assert "not other.exr" in prtbake("shade", asset, "--light", skies[1], *eye, *picture).err
    turned = prtbake("shade", asset, "--light", skies[0], "--rotate", "90", "--eye", "3,0,0", *picture)
    assert "not one.exr rotated by 90 degrees" in turned.err
    assert "colours are wrong" in turned.err
