"""Low bands: what they are as a function, as a file, in every way of evaluating it, and beside lobes."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from bakers.transport import smooth, up_to
from formats.errors import ModelError
from prt_bake.mathematics import sh
from prt_bake.mathematics.sphere import fibonacci, uniform
from prt_bake.network.bssrdf import NetworkSettings, NeuralBSSRDF, load_model, save_model
from prt_bake.network.features.shape import MAX_SLOPE, SLOPE_SCALE
from prt_bake.network.inference.pairs import pair_transport
from prt_bake.network.low_bands import LowBands, low_harmonics
from prt_bake.network.settings import AXIS_LENGTH, MOST_CHANNELS
from prt_bake.network.starting_weights import earlier_low_bands, start_from
from tests.network import WITHOUT_MESH
from tests.network.test_lobes import LOBED, glass_ball
from tests.network.test_material import ramps, with_material

pytestmark = WITHOUT_MESH

WIDTH = 12  # with fewer, MKL's products on some processors depend on the place of a row
SETTINGS = replace(LOBED, low_width=WIDTH)
POSITIONS, OUTGOING = 0.5 + 0.3 * uniform(12, 1), uniform(12, 2)


def network(settings: NetworkSettings = SETTINGS) -> NeuralBSSRDF:
    """A network whose coefficients are as large as its other values."""
    made = NeuralBSSRDF(settings, output_scale=0.7, interior=glass_ball(1.4))
    if made.low is not None:
        with torch.no_grad():
            made.low.output.weight.mul_(10.0)
    return made


def corrected(settings: NetworkSettings = SETTINGS) -> NeuralBSSRDF:
    """A network whose correction is as large as its values."""
    made = network(replace(settings, correction_width=WIDTH))
    assert made.correction is not None
    with torch.no_grad():
        made.correction.output.weight.mul_(10.0)
    return made


def coefficients(made: NeuralBSSRDF) -> np.ndarray:
    """a_lm [N,9,3] of the low bands."""
    with torch.no_grad():
        low = made.low_coefficients(torch.from_numpy(POSITIONS), torch.from_numpy(OUTGOING))
    return low.double().numpy() * made.output_scale


def projected(made: NeuralBSSRDF, directions: int, degree: int = 4) -> np.ndarray:
    """a_lm [N,K,3] of values in a few directions."""
    lattice = fibonacci(directions)
    values = made.evaluate(lattice, POSITIONS, OUTGOING).astype(np.float64)
    return np.asarray(np.einsum("kd,ndc->nkc", np.linalg.pinv(sh.evaluate(lattice, degree)), values))


def test_harmonics_are_those_of_the_other_modules() -> None:
    directions = uniform(50, 3)
    found = low_harmonics(torch.from_numpy(directions))
    np.testing.assert_allclose(found.double().numpy(), sh.evaluate(directions, 2), atol=1e-6)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_up_to_low_degrees_a_network_is_its_low_bands(degree: int) -> None:
    made = network()
    found, expected, kept = projected(made.up_to(degree), 30), coefficients(made), sh.count(degree)
    np.testing.assert_allclose(found[:, :kept], expected[:, :kept], atol=1e-5)
    np.testing.assert_allclose(found[:, kept:], 0.0, atol=1e-5)
    assert np.abs(expected).min(axis=(0, 2)).all()


def test_all_other_bands_are_those_of_the_other_layers() -> None:
    made, plain = network(), network(LOBED)
    lattice = fibonacci(40)
    for with_low, without in ((made, plain), (made.up_to(3), plain.up_to(3)), (made.smooth(2), plain.up_to(2))):
        np.testing.assert_array_equal(
            with_low.evaluate(lattice, POSITIONS, OUTGOING), without.evaluate(lattice, POSITIONS, OUTGOING)
        )
    assert made.up_to(2).up_to(3).only_low is made.only_low is False


@pytest.mark.parametrize("settings", [SETTINGS, replace(SETTINGS, lobes=0)])
def test_a_correction_changes_the_bands_to_degree_2_of_the_values(settings: NetworkSettings) -> None:
    made, plain = corrected(settings), network(settings)
    lattice = fibonacci(200)
    for with_it, without in ((made, plain), (made.smooth(2), plain.smooth(2))):
        difference = with_it.evaluate(lattice, POSITIONS, OUTGOING).astype(np.float64)
        difference -= without.evaluate(lattice, POSITIONS, OUTGOING)
        found = np.einsum("kd,ndc->nkc", np.linalg.pinv(sh.evaluate(lattice, 4)), difference)
        assert np.abs(found[:, :9]).min(axis=(0, 2)).all()
        np.testing.assert_allclose(difference, sh.evaluate(lattice, 2) @ found[:, :9], atol=2e-6)
        np.testing.assert_allclose(found[:, 9:], 0.0, atol=2e-6)
    np.testing.assert_array_equal(coefficients(made), coefficients(plain))


def test_lobes_are_those_of_harmonics_about_their_axes() -> None:
    """Each band l of a lobe about an axis v is its weight times |v|^l Y_lm(v / |v|)."""
    unit, lengths, weights = uniform(40, 6).reshape(20, 2, 3), np.array([1.0, 0.3]), uniform(4, 7).reshape(2, 2, 3)
    low = LowBands(8, 4, 3, torch.Generator(), (2, 5))
    with torch.no_grad():
        for parameters in low.parameters():
            parameters.zero_()
        low.output.bias[27:] = torch.from_numpy(weights).flatten()
    features = np.concatenate((np.ones((20, 2)), (AXIS_LENGTH * lengths[:, None] * unit).reshape(20, 6)), axis=1)
    with torch.no_grad():
        found = low(torch.from_numpy(features)).numpy()
    expected, basis = np.zeros((20, 9, 3)), sh.evaluate(unit, 2)
    for degree, rows in ((1, slice(1, 4)), (2, slice(4, 9))):
        expected[:, rows] = np.einsum("njm,j,jc->nmc", basis[..., rows], lengths**degree, weights[degree - 1])
    np.testing.assert_allclose(found, expected, atol=1e-6)


@pytest.mark.parametrize(
    "changes", [{}, {"grid_places": 0}, {"shape_places": 1}, {"lobes": 0, "interfaces": 4}, {"tells_normal": False}]
)
def test_the_axes_are_directions_of_the_view_normal_and_slopes(changes: dict[str, int]) -> None:
    settings = replace(SETTINGS, **({"lobes": 0} if "tells_normal" in changes else {}), **changes)
    made = network(settings)
    assert made.view is not None
    assert made.low is not None
    x, eye = torch.from_numpy(0.5 + 0.45 * uniform(12, 1)), torch.from_numpy(OUTGOING)
    encoding = made.encode_views(x, eye)
    assert encoding is not None
    axes = made.view_features(x, eye, encoding)[:, made.low.axis_columns].reshape(12, 3, -1) / AXIS_LENGTH
    normals = int(settings.tells_normal)
    back = made.view.back(eye.float(), encoding.axes[:, 0]) if normals else eye.float()
    assert axes.shape[2] == normals + 4 * settings.shape_places + 2 == len(settings.axis_columns)
    assert bool((back - eye).abs().amax(dim=1).gt(0.01).all()) == settings.tells_normal
    torch.testing.assert_close(axes[..., -2:], torch.stack((eye.float(), back), dim=-1))
    torch.testing.assert_close(axes[..., :normals], encoding.axes[:, :normals].transpose(1, 2))
    scale = SLOPE_SCALE * MAX_SLOPE / AXIS_LENGTH
    slopes = axes[..., normals : normals + 4].transpose(1, 2) / scale
    torch.testing.assert_close(slopes, encoding.axes[:, normals : normals + 4], atol=1e-5, rtol=0.0)


def test_a_transport_is_limited_by_its_own_methods() -> None:
    made = network()
    assert (up_to(made, 2).only_low, smooth(made, 2).only_low, smooth(made, 2).band) == (True, False, 2)
    assert smooth(np.sin, 2) is np.sin


LIMITED: dict[str, Callable[[], NeuralBSSRDF]] = {
    "low bands": lambda: network().up_to(2),
    "low bands without lobes": lambda: network(replace(SETTINGS, low_axes=False)).up_to(2),
    "corrected": corrected,
    "corrected, its lobes to degree 2": lambda: corrected().smooth(2),
    "corrected, without lobes": lambda: corrected(replace(SETTINGS, lobes=0)),
}


@pytest.mark.parametrize("limited", LIMITED)
def test_every_way_of_evaluating_agrees(limited: str) -> None:
    low = LIMITED[limited]()
    incident, rotation = np.stack([fibonacci(7), fibonacci(7)[:, ::-1]]), np.arange(12).reshape(6, 2) % 2
    outgoing = OUTGOING.reshape(6, 2, 3)
    positions, towards = POSITIONS[:6], incident[rotation].reshape(12, 7, 3)
    expected = low.evaluate(towards, np.repeat(positions, 2, axis=0), OUTGOING)
    for precision, off in (("float32", 3e-6), ("bfloat16", 3e-6 if low.only_low else 0.02)):
        block = low.prepared(precision).evaluate_block(incident, rotation, positions, outgoing)
        np.testing.assert_allclose(block.reshape(12, 7, 3), expected, rtol=1e-5, atol=off * np.abs(expected).max())
    if low.band is None or low.only_low:
        pairs = pair_transport(low).evaluate_pairs(towards, np.repeat(positions, 2, axis=0), OUTGOING)
        np.testing.assert_allclose(pairs, expected, rtol=1e-5, atol=3e-6 * np.abs(expected).max())


@pytest.mark.parametrize("limited", LIMITED)
def test_a_value_does_not_depend_on_others_in_its_block(limited: str) -> None:
    fused = LIMITED[limited]().prepared()
    incident, rotation = fibonacci(9)[None], np.zeros((300, 1), np.int64)
    positions, outgoing = 0.5 + 0.3 * uniform(300, 4), uniform(300, 5)[:, None]
    whole = fused.evaluate_block(incident, rotation, positions, outgoing)
    part = fused.evaluate_block(incident, rotation[270:], positions[270:], outgoing[270:])
    np.testing.assert_array_equal(whole[270:], part)


def test_a_file_keeps_low_bands_and_correction(tmp_path: Path) -> None:
    made = corrected()
    save_model(made, tmp_path / "model.pt")
    again = load_model(tmp_path / "model.pt")
    assert isinstance(again, NeuralBSSRDF)
    np.testing.assert_array_equal(coefficients(again), coefficients(made))
    np.testing.assert_array_equal(projected(again, 20), projected(made, 20))


def test_other_low_bands_have_no_correction() -> None:
    made, plain = corrected(), network()
    made.set_low_bands(made.low)
    assert made.settings == plain.settings
    np.testing.assert_array_equal(projected(made, 40), projected(plain, 40))
    with_correction = corrected()
    assert with_correction.correction is not None
    made.set_correction(with_correction.correction)
    assert made.settings == with_correction.settings
    np.testing.assert_array_equal(projected(made, 40), projected(with_correction, 40))


def test_a_network_can_lose_them_and_take_others() -> None:
    made, plain, other = network(), network(LOBED), network()
    low, settings = made.low, made.settings
    made.set_low_bands(None)
    assert made.settings == plain.settings
    np.testing.assert_array_equal(projected(made.up_to(2), 40), projected(plain.up_to(2), 40))
    made.set_low_bands(low)
    assert made.settings == settings
    np.testing.assert_array_equal(coefficients(made), coefficients(other))


def test_a_training_starts_from_low_bands_if_there_are_any() -> None:
    earlier, new, other, drawn = (network() for _ in range(4))
    assert earlier.low is not None
    with torch.no_grad():
        for weights in earlier.low.parameters():
            weights.add_(0.1)
    start_from(new, earlier)
    np.testing.assert_array_equal(coefficients(new), coefficients(earlier))
    start_from(other, network(LOBED))
    assert other.low is not None
    assert drawn.low is not None
    for found, expected in zip(other.low.parameters(), drawn.low.parameters(), strict=True):
        assert torch.equal(found, expected)


def test_low_bands_of_another_depth_begin_anew() -> None:
    earlier, deeper, drawn = network(replace(SETTINGS, low_layers=3)), network(), network()
    start_from(deeper, earlier)
    np.testing.assert_array_equal(coefficients(deeper), coefficients(drawn))
    assert not np.allclose(coefficients(deeper), coefficients(earlier), rtol=0.1)
    assert drawn.settings.low_layers == 5
    drawn.set_low_bands(earlier.low)
    assert drawn.settings == earlier.settings


def test_low_bands_without_lobes_are_a_start_for_those_with_them() -> None:
    earlier, new = network(replace(SETTINGS, low_axes=False)), network()
    assert not np.allclose(coefficients(new), coefficients(earlier), rtol=0.1)
    start_from(new, earlier)
    np.testing.assert_allclose(coefficients(new), coefficients(earlier), atol=1e-6)


@pytest.mark.parametrize("changes", [{}, {"low_layers": 3}, {"low_axes": False}, {"low_layers": 3, "low_axes": False}])
def test_earlier_low_bands_are_the_same_function_of_the_inputs_of_a_new_network(changes: dict[str, int]) -> None:
    earlier, new = network(replace(SETTINGS, **changes)), network()
    new.set_low_bands(earlier_low_bands(new.settings, earlier))
    np.testing.assert_allclose(coefficients(new), coefficients(earlier), atol=1e-6)


def test_earlier_low_bands_need_their_inputs() -> None:
    settings = network().settings
    assert earlier_low_bands(settings, network()) is not None
    assert earlier_low_bands(settings, network(LOBED)) is None
    assert earlier_low_bands(replace(settings, low_axes=False), network()) is None
    assert earlier_low_bands(settings, network(replace(SETTINGS, lobes=0))) is None


@pytest.mark.parametrize(("before", "now"), [(0, 4), (4, 4), (4, 0), (4, 2)])
def test_earlier_low_bands_may_lack_the_parts_of_the_ray(before: int, now: int) -> None:
    """They keep their values then; parts that only they have, or that are others, are refused."""
    interior, settings = with_material(ramps), replace(SETTINGS, material_channels=MOST_CHANNELS)
    earlier, new = (
        NeuralBSSRDF(replace(settings, material_parts=parts), (0.0, 0.0, 0.0), 1.0, 1.0, interior=interior)
        for parts in (before, now)
    )
    found = earlier_low_bands(new.settings, earlier)
    assert (found is None) == (before not in (0, now))
    if found is not None:
        new.set_low_bands(found)
        np.testing.assert_allclose(coefficients(new), coefficients(earlier), atol=1e-6)


def test_deeper_low_bands_are_kept_in_files(tmp_path: Path) -> None:
    made = network(replace(SETTINGS, low_layers=4))
    assert made.low is not None
    before = coefficients(made)
    with torch.no_grad():
        made.low.hidden[3].weight.fill_(0.25)
    assert not np.allclose(coefficients(made), before, rtol=0.1)
    save_model(made, tmp_path / "model.pt")
    again = load_model(tmp_path / "model.pt")
    assert isinstance(again, NeuralBSSRDF)
    assert again.settings.low_layers == 4
    np.testing.assert_array_equal(coefficients(again), coefficients(made))


def test_settings_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ModelError, match="low_width must not be negative, and must be 0 without light_layers"):
        NetworkSettings(low_width=8)
    with pytest.raises(ModelError, match="low_width"):
        replace(SETTINGS, low_width=-1)
    with pytest.raises(ModelError, match="low_layers must be at least 3, found 2"):
        replace(SETTINGS, low_layers=2)
    with pytest.raises(ModelError, match="low_axes needs ray_samples"):
        NetworkSettings(low_axes=True)
    with pytest.raises(ModelError, match="correction_width must not be negative, and must be 0 without low_width"):
        replace(LOBED, correction_width=8)
