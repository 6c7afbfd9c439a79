import dataclasses
from pathlib import Path

import numpy as np
import pytest

import prt_bake as prt
from formats.errors import QueryError
from prt_bake.export import engine_form as forms
from prt_bake.export.engine_errors import degrees_for, errors_by_degree, form_error
from prt_bake.export.engine_form import engine_form
from prt_bake.export.quantization import dequantized, quantized
from prt_bake.mathematics import sh
from tests.export.assets import ball, smooth_asset, view_directions

SKY = np.array([[1.0, 0.8, 0.6], *([[0.3, -0.2, 0.1]] * 8)])


def of_bins(form: forms.EngineForm, asset: prt.Asset) -> np.ndarray:
    """The coefficients [V,B,K,3] that a form gives at the view bins."""
    basis = sh.evaluate(view_directions(asset.mesh), form.view_degree)
    return np.einsum("vbr,vrkc->vbkc", basis, form.coefficients)


def test_a_transport_without_view_dependence_is_kept_in_every_degree() -> None:
    asset = smooth_asset()
    constant = np.repeat(np.asarray(asset.coefficients)[:, :1], asset.coefficients.shape[1], axis=1)
    for degree in (0, 1, 3, 8):
        form = engine_form(dataclasses.replace(asset, coefficients=constant), degree)
        np.testing.assert_allclose(of_bins(form, asset), constant, atol=2e-3 * np.abs(constant).max())
    single = engine_form(dataclasses.replace(asset, coefficients=constant[:, :1]), 3)
    assert single.view_degree == 0
    outgoing = np.tile([[0.6, 0.0, 0.8]], (len(constant), 1))
    expected = np.einsum("vkc,kc->vc", constant[:, 0], SKY)
    np.testing.assert_allclose(single.radiance(np.arange(len(constant)), outgoing, SKY), expected, rtol=1e-5)


def test_the_error_is_that_of_the_coefficients_and_falls_with_the_degree() -> None:
    asset = smooth_asset()
    true = np.asarray(asset.coefficients, np.float64)
    for degree in (2, 5):
        form = engine_form(asset, degree)
        error = form_error(asset, form, SKY)
        difference = ((of_bins(form, asset) - true) ** 2).sum(axis=(1, 2, 3))
        norm = (true**2).sum(axis=(1, 2, 3))
        assert error.coefficients == pytest.approx(np.sqrt(difference.sum() / norm.sum()), rel=1e-4)
        assert error.coefficients_95 == pytest.approx(np.percentile(np.sqrt(difference / norm), 95), rel=1e-4)
    errors = errors_by_degree(asset)
    assert errors[2] == pytest.approx(form_error(asset, engine_form(asset, 2), SKY).coefficients, rel=1e-3)
    assert (np.diff(errors[:5]) < 0.0).all()
    assert errors[8] < 0.02


def test_the_error_of_radiance_is_that_of_shaded_vertices() -> None:
    asset = smooth_asset()
    form = engine_form(asset, 3)
    error = form_error(asset, form, SKY)
    low, high = asset.mesh.positions.min(axis=0), asset.mesh.positions.max(axis=0)
    worst = 0.0
    for axis in (*np.eye(3), *-np.eye(3)):
        eye = (low + high) / 2.0 + 2.0 * np.linalg.norm(high - low) * axis
        outgoing = eye - asset.mesh.positions
        outgoing /= np.linalg.norm(outgoing, axis=1, keepdims=True)
        facing = (outgoing * asset.mesh.normals).sum(axis=1) > 0.0
        for direction in ([0.6, 0.64, 0.48], [-0.48, 0.6, -0.64], [0.64, -0.48, 0.6], None):
            light = SKY if direction is None else np.repeat(sh.evaluate(direction, 2)[:, None], 3, axis=1)
            true = prt.shade(asset, light, eye)[facing]
            found = np.maximum(form.radiance(np.arange(len(outgoing)), outgoing, light), 0.0)[facing]
            worst = max(worst, float(np.sqrt(((found - true) ** 2).sum() / (true**2).sum())))
    assert error.radiance_worst == pytest.approx(worst, rel=1e-4)
    assert 0.0 < error.radiance_median < error.radiance_worst


def test_the_least_degree_within_an_error_is_chosen() -> None:
    asset = smooth_asset()
    errors = errors_by_degree(asset)
    degree, *_, highest = degrees_for(asset, 0.05)
    assert errors[degree] <= 0.05 < errors[degree - 1]
    assert highest == 8
    with pytest.raises(QueryError, match=r"degree 8 leave .*, expected 1e-06 or less"):
        degrees_for(asset, 1e-6)


@pytest.mark.parametrize("error", [0.0, 1.0, -0.1, float("nan")])
def test_an_error_that_is_none_is_refused(error: float) -> None:
    with pytest.raises(QueryError, match="error: expected a number between 0 and 1"):
        degrees_for(smooth_asset(), error)


def test_an_object_that_is_turned_has_the_same_radiance() -> None:
    turn = np.array([[0.0, -0.6, 0.8], [1.0, 0.0, 0.0], [0.0, 0.8, 0.6]])
    mesh = ball()
    asset = smooth_asset(mesh)
    moved = dataclasses.replace(
        asset,
        mesh=prt.Mesh(mesh.positions @ turn.T, mesh.faces, mesh.normals @ turn.T),
        tangents=np.asarray(asset.tangents) @ turn.T,
        coefficients=np.einsum("lk,vbkc->vblc", sh.rotation(turn, 2), asset.coefficients).astype(np.float32),
    )
    vertices = np.arange(0, len(mesh.positions), 7)
    outgoing = np.tile([[0.36, 0.48, 0.8]], (len(vertices), 1))
    before = engine_form(asset, 3).radiance(vertices, outgoing, SKY)
    after = engine_form(moved, 3).radiance(vertices, outgoing @ turn.T, sh.rotation(turn, 2) @ SKY)
    np.testing.assert_allclose(after, before, atol=1e-5 * np.abs(before).max())


def test_below_the_horizon_the_form_stays_near_the_last_ring() -> None:
    asset = smooth_asset()
    form = engine_form(asset, 3)
    grazing = asset.mesh.normals * -0.15 + np.asarray(asset.tangents) * np.sqrt(1 - 0.15**2)
    true = prt.shade(asset, SKY, grazing)
    found = np.maximum(form.radiance(np.arange(len(grazing)), grazing, SKY), 0.0)
    assert np.sqrt(((found - true) ** 2).sum() / (true**2).sum()) < 0.15


def test_coarse_view_bins_are_followed_between_their_centres() -> None:
    asset = smooth_asset()
    coarse = dataclasses.replace(
        asset,
        rings=2,
        sectors=4,
        directions=prt.sphere.view_bins(2, 4),
        coefficients=np.asarray(asset.coefficients)
        .reshape(-1, 2, 4, 4, 8, 9, 3)
        .mean(axis=(2, 4))
        .reshape(-1, 8, 9, 3),
    )
    assert form_error(coarse, engine_form(coarse, 8), SKY).radiance_worst < 0.1


def test_one_light_is_folded_in() -> None:
    asset = smooth_asset()
    folded, whole = engine_form(asset, 3, SKY), engine_form(asset, 3)
    assert folded.coefficients.shape[1:] == (16, 1, 3)
    assert folded.quantity == "radiance"
    np.testing.assert_allclose(
        folded.coefficients[:, :, 0], np.einsum("vrkc,kc->vrc", whole.coefficients, SKY), rtol=1e-3, atol=1e-4
    )
    error = form_error(asset, folded, SKY, SKY)
    assert 0.0 < error.coefficients < 0.2


def test_channels_that_are_equal_and_vertices_that_were_not_baked() -> None:
    asset = smooth_asset()
    valid = np.arange(len(asset.valid)) % 5 != 2
    grey = dataclasses.replace(asset, coefficients=np.asarray(asset.coefficients)[..., :1], valid=valid)
    form = engine_form(grey, 2)
    assert (form.coefficients == form.coefficients[..., :1]).all()
    assert not form.coefficients[~valid].any()
    assert form_error(grey, form, SKY).coefficients < 0.2
    with pytest.raises(QueryError, match="no vertex was baked"):
        engine_form(dataclasses.replace(grey, valid=np.zeros_like(valid)))


def test_numbers_of_vertices_that_were_not_baked_do_not_matter_others_must_be_finite() -> None:
    asset = smooth_asset()
    valid = np.arange(len(asset.valid)) != 7
    coefficients = np.asarray(asset.coefficients).copy()
    coefficients[7] = np.nan
    partial = dataclasses.replace(asset, coefficients=coefficients, valid=valid)
    form = engine_form(partial, 2)
    assert not form.coefficients[7].any()
    assert 0.0 < form_error(partial, form, SKY).coefficients < 0.3
    coefficients[9, 3] = np.inf
    with pytest.raises(QueryError, match="coefficients of vertex 9 are not finite"):
        engine_form(partial, 2)


def test_the_error_is_relative_for_dim_assets_too() -> None:
    asset = smooth_asset()
    dim = dataclasses.replace(asset, coefficients=np.asarray(asset.coefficients) * np.float32(1e-18))
    expected = form_error(asset, engine_form(asset, 2), SKY).coefficients
    assert form_error(dim, engine_form(dim, 2), SKY).coefficients == pytest.approx(expected, rel=1e-3)
    assert errors_by_degree(dim)[2] == pytest.approx(expected, rel=1e-3)


def test_few_view_bins_do_not_make_large_blocks() -> None:
    mesh = prt.Mesh(np.eye(3).repeat(1000, axis=0), np.array([[0, 1000, 2000]]), np.eye(3).repeat(1000, axis=0))
    asset = smooth_asset(mesh)
    still = dataclasses.replace(asset, coefficients=np.asarray(asset.coefficients)[:, :1])
    sizes = [part.stop - part.start for part, _ in forms.blocks(still)]
    assert sum(sizes) == 3000
    assert max(sizes) * 8 * 81**2 <= 64 << 20


def test_eight_bits_add_less_than_the_fit() -> None:
    asset = smooth_asset()
    form = engine_form(asset, 3)
    stored = quantized(form)
    assert stored.codes.dtype == np.int8
    assert np.abs(stored.codes.astype(int)).max() == 127
    read = dequantized(form, stored)
    assert (np.abs(read.coefficients - form.coefficients) <= stored.scales / 127 * 0.501).all()


def brightened(factors: dict[int, float]) -> prt.Asset:
    asset = smooth_asset()
    values = np.array(asset.coefficients)
    for vertex, factor in factors.items():
        values[vertex] *= factor
    return dataclasses.replace(asset, coefficients=values)


@pytest.mark.parametrize("factor", [10.0, 1e4])
def test_a_bright_vertex_that_takes_the_bits_of_the_others_is_named(tmp_path: Path, factor: float) -> None:
    asset = brightened({7: factor})
    with pytest.warns(prt.InputWarning, match=r"8 bits alone are .* off .*: vertex 7 with up to .*export"):
        prt.export_gltf(asset, tmp_path / "x.glb", quantize="int8")
    prt.export_gltf(asset, tmp_path / "x.glb")


def test_the_warning_names_three_of_several_bright_vertices(tmp_path: Path) -> None:
    with pytest.warns(prt.InputWarning, match="5 vertices 9, 8, 7, … with up to"):
        prt.export_gltf(brightened({v: 10.0**v for v in range(5, 10)}), tmp_path / "x.glb", quantize="int8")


def test_8_bits_of_a_usual_asset_are_no_warning(tmp_path: Path) -> None:
    usual = smooth_asset()
    for asset in (usual, brightened({7: 3.0}), brightened(dict.fromkeys(range(100), 0.0))):
        prt.export_gltf(asset, tmp_path / "x.glb", quantize="int8")  # warnings are errors
    dark = dataclasses.replace(usual, coefficients=np.zeros_like(usual.coefficients))
    prt.export_gltf(dark, tmp_path / "x.glb", quantize="int8")


@pytest.mark.parametrize("degree", [-1, 9])
def test_other_degrees_are_refused(degree: int) -> None:
    with pytest.raises(QueryError, match="degree: expected 0 to 8"):
        engine_form(smooth_asset(), degree)
