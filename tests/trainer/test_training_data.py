"""Tests of the data that a training learns from."""

from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import torch

from prt_bake.trainer.samples.stream import BackgroundRenderer
from prt_bake.trainer.training_data import PathTracedData
from tests.shapes import ball
from tests.tracer.scenes import make_scene
from tests.trainer.small_training import LEARNING, STREAM


@pytest.mark.parametrize(("device", "reuse"), [("cpu", 2), ("cuda", np.inf)])
def test_only_a_learner_on_the_renderer_s_cores_waits_for_rows(tmp_path: Path, device: str, reuse: float) -> None:
    data = PathTracedData(make_scene(tmp_path, ball(1)), replace(STREAM, reuse=2), 0, False)
    source = data.source(LEARNING, mock.Mock(frequencies=mock.Mock(device=torch.device(device))), None)
    assert isinstance(source, BackgroundRenderer)
    assert source.reuse == reuse
