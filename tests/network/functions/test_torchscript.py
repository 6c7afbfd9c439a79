"""Tests of TorchScript files as transports: their seven inputs, and refused files."""

import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

from formats.errors import ModelError, QueryError
from prt_bake.network.functions import Convention, load_function


class FirstThree(torch.nn.Module):
    def forward(self, rows: torch.Tensor) -> torch.Tensor:
        return rows[:, 0:3] + 10.0 * rows[:, 3:6] + 100.0 * rows[:, 6:7]


class Wide(torch.nn.Module):
    def forward(self, rows: torch.Tensor) -> torch.Tensor:
        return rows[:, 0:4]


class Narrow(torch.nn.Module):
    def forward(self, rows: torch.Tensor) -> torch.Tensor:
        return rows @ torch.ones(9, 3)


class Counting(torch.nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("calls", torch.zeros(1))

    def forward(self, rows: torch.Tensor) -> torch.Tensor:
        self.calls += 1
        return rows[:, 0:3] * self.calls


class Overwriting(torch.nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.gain = torch.nn.Parameter(torch.ones(1, dtype=torch.float64))

    def forward(self, rows: torch.Tensor) -> torch.Tensor:
        return self.gain * rows.mul_(2.0)[:, 0:3]


def script(module: torch.nn.Module, tmp_path: Path) -> Path:
    path = tmp_path / "script.pt"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.jit.save(torch.jit.script(module), str(path))
    return path


@pytest.mark.parametrize(
    ("convention", "rows"),
    [
        ("incident, position, outgoing", [0.5, 0.25, 0.25, 0.5, 0.75, 0.5, 0.75]),
        ("position,outgoing,incident; position=object", [1.5, 2.0, 2.5, 0.5, 0.75, 0.5, 0.25]),
        ("outgoing,position,incident; angles=radians; axis=y", [np.pi, 0, 0.25, 0.5, 0.75, 0, 0]),
    ],
)
def test_the_seven_inputs_follow_the_convention(convention: str, rows: list[float], tmp_path: Path) -> None:
    transport = load_function(script(FirstThree(), tmp_path), convention, (1.0, 1.0, 1.0), 2.0)
    answer = transport.evaluate([[0.0, 1.0, 0.0]], [[1.5, 2.0, 2.5]], [[0.0, -1.0, 0.0]])
    expected = np.array(rows[0:3]) + 10 * np.array(rows[3:6]) + 100 * rows[6]
    np.testing.assert_allclose(answer[0, 0], expected, rtol=1e-6)


def test_separate_and_shared_directions_agree(tmp_path: Path) -> None:
    transport = load_function(script(FirstThree(), tmp_path))
    light, positions = np.array([[0.0, 0.6, 0.8], [1.0, 0.0, 0.0]]), np.array([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])
    separate = np.stack([light, light])
    np.testing.assert_array_equal(
        transport.evaluate(light, positions, light), transport.evaluate(separate, positions, light)
    )


@pytest.mark.parametrize("module", [Wide(), Narrow()])
def test_functions_of_another_shape_are_refused(module: torch.nn.Module, tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"script\.pt"):
        load_function(script(module, tmp_path))


def test_a_network_that_was_traced_while_it_was_trained_is_refused(tmp_path: Path) -> None:
    path, layers = tmp_path / "traced.pt", (torch.nn.Linear(7, 16), torch.nn.Linear(16, 3))
    for between, cause in (
        (torch.nn.Dropout(0.1), "from call to call, as with dropout"),
        (torch.nn.BatchNorm1d(16), "with the other rows of a batch, as with batch normalisation"),
    ):
        network = torch.nn.Sequential(layers[0], between, layers[1])
        for training in (True, False):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                torch.jit.save(torch.jit.trace(network.train(training), torch.rand(4, 7), check_trace=False), str(path))
            if not training:
                load_function(path)
                continue
            with pytest.raises(ModelError, match=rf"traced\.pt: .*{cause}.* network\.eval\(\)"):
                load_function(path)


def test_a_function_with_a_state_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="from call to call"):
        load_function(script(Counting(), tmp_path))


def test_a_function_may_write_into_its_rows(tmp_path: Path) -> None:
    transport = load_function(script(Overwriting(), tmp_path), "position, incident, outgoing")
    found = transport.evaluate([[0, 0, 1]], [[0.1, 0.2, 0.3]], [[0, 0, 1]])
    np.testing.assert_allclose(found, [[[0.2, 0.4, 0.6]]], rtol=1e-6)


class Strict(torch.nn.Module):
    """Wants rows of ten numbers."""

    def forward(self, rows: torch.Tensor) -> torch.Tensor:
        assert rows.shape[1] == 10
        return rows[:, :3]


def test_a_function_that_asserts_other_rows_is_named(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"failed on \[\d+, 7\] of float32"):
        load_function(script(Strict(), tmp_path))


def test_other_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="no such file"):
        load_function(tmp_path / "none.pt")
    (tmp_path / "words.pt").write_text("words")
    with pytest.raises(ModelError, match=r"words\.pt: not a TorchScript file"):
        load_function(tmp_path / "words.pt")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("incident, outgoing", "in some order"),
        ("incident, position, outgoing; colour=red", "unknown key 'colour'"),
        ("incident, position, outgoing; axis=x", "axis must be z or y"),
    ],
)
def test_bad_conventions_are_refused(text: str, message: str) -> None:
    with pytest.raises(QueryError, match=message):
        Convention.parse(text)
