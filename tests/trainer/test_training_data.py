"""Tests of the data that a training learns from."""

from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import torch

from formats.scene import read_scene
from prt_bake.trainer.samples.stream import BackgroundRenderer
from prt_bake.trainer.train import train
from prt_bake.trainer.training_data import PathTracedData
from tests import ROOT
from tests.network.test_view_path import REFLECTING
from tests.shapes import ball
from tests.tracer.scenes import make_scene
from tests.trainer.small_training import LEARNING, STREAM


@pytest.mark.parametrize(("device", "reuse"), [("cpu", 2), ("cuda", np.inf)])
def test_only_a_learner_on_the_renderer_s_cores_waits_for_rows(tmp_path: Path, device: str, reuse: float) -> None:
    data = PathTracedData(make_scene(tmp_path, ball(1)), replace(STREAM, reuse=2), 0, False)
    source = data.source(LEARNING, mock.Mock(box_min=mock.Mock(device=torch.device(device))), None)
    assert isinstance(source, BackgroundRenderer)
    assert source.reuse == reuse


@pytest.mark.statistics
def test_a_network_of_a_clear_object_has_what_is_inside() -> None:
    scene = read_scene(ROOT / "scenes" / "paperweight" / "cow.toml")
    network = train(scene, steps=1, synchronous=True, settings=REFLECTING, stream=STREAM, learning=LEARNING)
    assert network.view is not None
    assert [len(body.faces) for body in network.view.interior.inner] == [len(scene.parts[1].mesh.faces)]
