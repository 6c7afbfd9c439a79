"""Callers give kernels arrays of one layout, so that each kernel is compiled once."""

import dataclasses
from typing import Any

import numba
import numpy as np
import pytest

from prt_bake.baking.compress import compress
from prt_bake.shading import compact_reconstruction, maximum_entropy, reconstruction
from prt_bake.shading.picture import shade
from tests.shading.assets import asset_of
from tests.shapes import ball


class Recorder:
    """Stands in for a kernel and records the types of its arguments."""

    def __init__(self) -> None:
        self.types: list[list[Any]] = []

    def __call__(self, *arguments: Any) -> None:
        self.types.append([numba.typeof(argument) for argument in arguments])


def test_compact_assets_in_memory_and_in_files_share_a_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compact_reconstruction, "_reconstruct", recorder := Recorder())
    coefficients = np.random.default_rng(0).normal(size=(18, 8, 9, 3)).astype(np.float32)
    asset = compress(asset_of(ball(1), coefficients, 2, 4, 2), 0.1)
    channels = asset.coefficients.channels
    for layout in (np.ascontiguousarray, np.asfortranarray):
        laid_out = dataclasses.replace(asset.coefficients, channels=layout(channels))
        shade(dataclasses.replace(asset, coefficients=laid_out), np.ones((9, 3)), [3.0, 0.0, 0.0])
    assert len(recorder.types) == 2
    assert recorder.types[0] == recorder.types[1]


def test_assets_that_can_and_cannot_be_written_share_a_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reconstruction, "_reconstruct", recorder := Recorder())
    for writable in (True, False):
        coefficients = np.ones((18, 8, 9, 3), np.float32)
        coefficients.flags.writeable = writable
        shade(asset_of(ball(1), coefficients, 2, 4, 2), np.ones((9, 3)), [3.0, 0.0, 0.0])
        assert coefficients.flags.writeable == writable
    assert recorder.types[0] == recorder.types[1]


def test_gradients_of_equal_and_of_different_channels_share_a_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    recorder = Recorder()
    monkeypatch.setattr(maximum_entropy, "in_threads", lambda _kernel, _rows, *arguments: recorder(*arguments))
    part = np.ones((2, 3, 8))
    for some in (part[:, :1], part):
        multipliers, logarithm = (
            np.broadcast_to(values, shape) for values, shape in ((some, (2, 3, 8)), (1.0, (2, 3)))
        )
        transport = maximum_entropy.MaximumEntropyTransport(logarithm, logarithm, multipliers)
        for suns in (np.eye(3)[:1], np.eye(3)):
            maximum_entropy.radiance_gradient(np.ones((2, 9, 3)), transport, suns, np.ones((len(suns), 3)))
    assert len(recorder.types) == 4
    assert all(types == recorder.types[0] for types in recorder.types)
