"""Tests of trainings that start from an earlier network: what they record, resume and refuse, and what they gain."""

from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

import prt_bake as prt
from formats.errors import ModelError, QueryError
from formats.scene import Scene, read_scene
from prt_bake.network.bssrdf import NeuralBSSRDF
from prt_bake.trainer.training_data import PathTracedData, learning_for
from tests.network import WITHOUT_MESH
from tests.trainer.learning.test_low_bands import trained
from tests.trainer.small_training import LEARNING, STREAM, make_scene, train_small

EAGER = replace(LEARNING, checkpoint_every=0.0)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return make_scene(tmp_path_factory.mktemp("scene"))


@pytest.fixture(scope="module")
def earlier(scene: Scene) -> NeuralBSSRDF:
    return train_small(scene, 3)


def recoloured(scene: Scene, folder: Path) -> Scene:
    """The same object, browner and less dense."""
    text = Path(scene.path).read_text()
    text = text.replace("sigma_t = 4.0", "sigma_t = 3.0").replace("0.9, 0.7, 0.5", "0.9, 0.6, 0.3")
    (folder / "brown.toml").write_text(text.replace('"ball.ply"', f'"{scene.mesh_path}"'))
    return read_scene(folder / "brown.toml")


def test_the_model_says_what_it_started_from(scene: Scene, earlier: NeuralBSSRDF) -> None:
    begun = train_small(scene, 2, start=earlier)
    assert begun.metadata["started_from"] == "scene.toml, 3 steps"
    assert "started_from" not in earlier.metadata
    assert begun.output_scale == earlier.output_scale


def test_the_first_step_begins_with_the_weights_of_the_earlier_network(scene: Scene, earlier: NeuralBSSRDF) -> None:
    moved = deepcopy(earlier)
    with torch.no_grad():
        moved.output.bias += 5.0
    begun = train_small(scene, 1, start=moved)
    assert (begun.output.bias - moved.output.bias).abs().max() < 0.5
    assert not torch.equal(begun.output.bias, moved.output.bias)
    torch.testing.assert_close(moved.output.bias, earlier.output.bias + 5.0)


def test_the_rate_is_lower_unless_it_is_given(scene: Scene, earlier: NeuralBSSRDF) -> None:
    data = PathTracedData(scene, STREAM, 0, False)
    usual, continued = learning_for(data), learning_for(data, started=True)
    assert continued.rate < usual.rate
    assert continued.coarse_steps == 0
    assert replace(continued, rate=usual.rate, coarse_steps=usual.coarse_steps) == usual
    shortened = replace(continued, held_out_queries=16, held_out_walks=16)
    given = train_small(scene, 1, start=earlier, learning=shortened).metadata["training"]["learning"]
    assert given["rate"] == continued.rate


def test_a_run_resumes_from_the_same_start_alone(scene: Scene, earlier: NeuralBSSRDF, tmp_path: Path) -> None:
    settings: dict[str, Any] = {"output": tmp_path / "m.pt", "learning": EAGER}
    train_small(scene, 2, start=earlier, **settings)
    with pytest.raises(ModelError, match=r"the run began with start '[0-9a-f]{64}', requested is None"):
        train_small(scene, 4, resume=True, **settings)
    resumed = train_small(scene, 4, resume=True, start=earlier, **settings)
    assert resumed.metadata["training"]["steps"] == 4


def test_what_is_no_neural_bssrdf_is_refused(scene: Scene) -> None:
    class Other:
        evaluate = settings = metadata = None

    with pytest.raises(QueryError, match="start: expected a neural BSSRDF, found Other; train without it"):
        train_small(scene, 1, start=Other())
    path: Any = "earlier.pt"
    with pytest.raises(QueryError, match=r"start: .*prt\.load_model"):
        prt.train(scene, steps=1, start=path)


@WITHOUT_MESH
@pytest.mark.statistics
def test_another_material_is_learned_in_fewer_steps(scene: Scene, tmp_path: Path) -> None:
    """The coefficients are nearer after 60 steps than those of a new network after as many."""
    earlier, brown = train_small(scene, 300), recoloured(scene, tmp_path)
    learning = replace(LEARNING, held_out_queries=256, held_out_walks=256)
    errors = [
        train_small(brown, 60, learning=learning, start=start).metadata["training"]["relative_rmse"]["coefficients"]
        for start in (None, earlier)
    ]
    assert errors[1] < 0.7 * errors[0]


@pytest.mark.parametrize("rays", ["exits", "values"])
def test_a_run_from_values_says_that_it_drops_earlier_low_bands(tmp_path: Path, rays: Any) -> None:
    rough, said = make_scene(tmp_path, eta=1.3, roughness=0.3), list[str]()
    start = trained(rough, 1, synchronous=True)
    made = trained(rough, 1, start=start, synchronous=True, stream=replace(STREAM, rays=rays), say=said.append)
    dropped = [sentence for sentence in said if "no low bands" in sentence]
    assert (made.low is None) == bool(dropped) == (rays == "values")
