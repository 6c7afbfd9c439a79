"""Low bands: what they are as a function, as a file, in every way of evaluating it, and beside lobes."""

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
from prt_bake.network.inference.pairs import pair_transport
from prt_bake.network.low_bands import low_harmonics
from prt_bake.network.starting_weights import start_from
from tests.network import WITHOUT_MESH
from tests.network.test_lobes import LOBED, glass_ball

pytestmark = WITHOUT_MESH

SETTINGS = replace(LOBED, low_width=10)
POSITIONS, OUTGOING = 0.5 + 0.3 * uniform(12, 1), uniform(12, 2)


def network(settings: NetworkSettings = SETTINGS) -> NeuralBSSRDF:
    """A network whose coefficients are as large as its other values."""
    made = NeuralBSSRDF(settings, output_scale=0.7, interior=glass_ball(1.4))
    if made.low is not None:
        with torch.no_grad():
            made.low.output.weight.mul_(10.0)
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


def test_a_transport_is_limited_by_its_own_methods() -> None:
    made = network()
    assert (up_to(made, 2).only_low, smooth(made, 2).only_low, smooth(made, 2).band) == (True, False, 2)
    assert smooth(np.sin, 2) is np.sin


def test_every_way_of_evaluating_low_bands_agrees() -> None:
    low = network().up_to(2)
    incident, rotation = np.stack([fibonacci(7), fibonacci(7)[:, ::-1]]), np.arange(12).reshape(6, 2) % 2
    outgoing = OUTGOING.reshape(6, 2, 3)
    positions, towards = POSITIONS[:6], incident[rotation].reshape(12, 7, 3)
    expected = low.evaluate(towards, np.repeat(positions, 2, axis=0), OUTGOING)
    for precision in ("float32", "bfloat16"):
        block = low.prepared(precision).evaluate_block(incident, rotation, positions, outgoing)
        np.testing.assert_allclose(block.reshape(12, 7, 3), expected, rtol=1e-5, atol=1e-6)
    pairs = pair_transport(low).evaluate_pairs(towards, np.repeat(positions, 2, axis=0), OUTGOING)
    np.testing.assert_allclose(pairs, expected, rtol=1e-5, atol=1e-6)


def test_a_value_does_not_depend_on_others_in_its_block() -> None:
    fused = network().up_to(2).prepared()
    incident, rotation = fibonacci(9)[None], np.zeros((300, 1), np.int64)
    positions, outgoing = 0.5 + 0.3 * uniform(300, 4), uniform(300, 5)[:, None]
    whole = fused.evaluate_block(incident, rotation, positions, outgoing)
    part = fused.evaluate_block(incident, rotation[270:], positions[270:], outgoing[270:])
    np.testing.assert_array_equal(whole[270:], part)


def test_a_file_keeps_low_bands(tmp_path: Path) -> None:
    made = network()
    save_model(made, tmp_path / "model.pt")
    again = load_model(tmp_path / "model.pt")
    assert isinstance(again, NeuralBSSRDF)
    np.testing.assert_array_equal(coefficients(again), coefficients(made))


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


def test_settings_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ModelError, match="low_width must not be negative, and must be 0 without light_layers"):
        NetworkSettings(low_width=8)
    with pytest.raises(ModelError, match="low_width"):
        replace(SETTINGS, low_width=-1)
