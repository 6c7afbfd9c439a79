"""Training rows and steps on a GPU are those of the processor: in numba's simulator, or on a GPU if there is one."""

from copy import deepcopy
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

from formats.errors import QueryError
from formats.scene import Scene
from prt_bake.network.bssrdf import PRESETS, NeuralBSSRDF
from prt_bake.tracer.prepared import prepare
from prt_bake.trainer.gpu.learner import GPU_LEARNING, GpuLearner
from prt_bake.trainer.gpu.renderer import GpuBatch, GpuRenderer
from prt_bake.trainer.gpu.resampling import resampled
from prt_bake.trainer.interior import interior_of, with_fitting_grid
from prt_bake.trainer.learning.learner import Learner, LearningSettings
from prt_bake.trainer.samples.resampling import resample_rows
from prt_bake.trainer.samples.rows import OUTGOING, POSITION, Batch, ExitTracer, StreamSettings
from prt_bake.trainer.training_data import box_of
from tests.tracer.scenes import lumpy, make_scene

REAL = torch.cuda.is_available()
DEVICE = "cuda" if REAL else "cpu"
STREAM = StreamSettings(queries_a_batch=32, exits=3, kept=3)
SMALL = replace(PRESETS["measured"], features=12, width=16, ray_samples=4, shape_places=2, grid_places=4, lobes=0)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return make_scene(tmp_path_factory.mktemp("scene"), lumpy(2), eta=1.4, roughness=0.3, sigma_t=3.0, phase_g=0.2)


@cache
def _network(scene: Scene) -> NeuralBSSRDF:
    box, interior = box_of(scene), interior_of(scene, box_of(scene), with_meshes=True)
    network = NeuralBSSRDF(with_fitting_grid(SMALL, interior), box.corner, box.side, 0.05, {}, interior)
    return network.to(DEVICE).on(scene.mesh)


def network_of(scene: Scene) -> NeuralBSSRDF:
    """A network that no step has changed."""
    return deepcopy(_network(scene))


def straight(positions: torch.Tensor, outgoing: torch.Tensor, normals: torch.Tensor) -> torch.Tensor:
    """No paths."""
    return positions[:, :0]


def numpy_of(tensor: torch.Tensor) -> np.ndarray:
    return np.asarray(tensor.detach().cpu().numpy())


class Drawn:
    """A source that names its queries by their numbers."""

    exits = True

    def describe(self, number: int) -> str:
        return f"query {number}"


DRAWN: Any = Drawn()


def test_light_that_crosses_unscattered_is_no_part_of_the_rows(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, lumpy(2), eta=1.3, sigma_t=0.2)
    prepared, box, stream = prepare(scene), box_of(scene), replace(STREAM, queries_a_batch=16)
    renderer = GpuRenderer(prepared, box, stream, 4, 16, "face", straight)
    renderer.start()
    rows = numpy_of(renderer.draw(16).rows)
    renderer.stop()
    expected = ExitTracer(prepared, box, stream, 4).render(0, 16)
    assert np.mean(expected.rays[..., 3:].any(axis=-1)) < 0.5
    assert_allclose(rows, expected.rows, atol=2e-5)


def test_rows_are_those_of_the_processor_from_any_number_on(scene: Scene) -> None:
    prepared, box = prepare(scene), box_of(scene)
    network = network_of(scene)
    begun = {"next_query": 64, "walks": 5, "rows": 6}
    renderer = GpuRenderer(prepared, box, STREAM, 4, 16, "face", network.packed_paths, begun)
    renderer.start()
    parts = [renderer.draw(16) for _ in range(4)]
    renderer.stop()
    tracer = ExitTracer(prepared, box, STREAM, 4)
    expected = tracer.render(64, 64)
    assert_allclose(np.concatenate([numpy_of(part.rows) for part in parts]), expected.rows, atol=2e-5)
    assert_array_equal(np.concatenate([numpy_of(part.numbers) for part in parts]), expected.numbers)
    assert renderer.traced is not None
    assert tracer.traced is not None
    there, here = renderer.traced.joined(), tracer.traced.joined()
    assert there is not None
    assert here is not None
    found = numpy_of(there.coefficients(slice(0, 64)))
    assert_allclose(found, numpy_of(here.coefficients(slice(None))), atol=1e-3)
    assert_allclose(numpy_of(there.views)[:64], expected.rows[:, :6], atol=2e-5)
    assert renderer.state() == {"next_query": 128, "walks": 5 + 64 * 3, "rows": 6 + 64}
    positions = network.box_min + network.box_side * parts[0].rows[:, POSITION].double()
    normals = network.mesh_normals(positions, parts[0].rows[:, OUTGOING])
    assert normals is not None
    # A position that float32 moves across an edge has the other face's normal.
    same = np.abs(numpy_of(parts[0].normals) - numpy_of(normals)).max(axis=1) < 1e-5
    assert np.mean(same) > 0.8
    paths = network.packed_paths(positions, parts[0].rows[:, OUTGOING], normals)
    assert np.mean(np.abs(numpy_of(parts[0].paths) - numpy_of(paths)).max(axis=1)[same] < 1e-3) > 0.8


def test_resampling_is_that_of_the_processor() -> None:
    generator = np.random.default_rng(0)
    directions = generator.normal(size=(50, 20, 3))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    directions = directions.astype(np.float32).astype(np.float64)
    throughput = generator.uniform(size=(50, 20, 3)) * (generator.uniform(size=(50, 20, 1)) < 0.5)
    throughput[7] = 0.0
    offsets, expected = generator.uniform(size=50), np.zeros((2, 50, 6, 3))
    resample_rows(0, 50, directions, throughput, offsets, expected[0], expected[1])
    tensors = (torch.from_numpy(array.astype(np.float32)).to(DEVICE) for array in (directions, throughput))
    kept, light = resampled(*tensors, 6, torch.from_numpy(offsets[:, None]).to(DEVICE))
    assert_allclose(numpy_of(light), expected[1], atol=1e-5)
    lit = expected[1].any(axis=(1, 2))
    assert_allclose(numpy_of(kept)[lit], expected[0][lit], atol=1e-6)
    assert not lit[7]


def batch_of(scene: Scene) -> tuple[Batch, GpuBatch]:
    here = ExitTracer(prepare(scene), box_of(scene), STREAM, 0).render(0, 32)
    network = network_of(scene)
    rows = torch.from_numpy(here.rows).to(DEVICE)
    positions = network.box_min + network.box_side * rows[:, POSITION].double()
    normals = network.mesh_normals(positions, rows[:, OUTGOING])
    assert normals is not None
    paths = network.packed_paths(positions, rows[:, OUTGOING], normals)
    return here, GpuBatch(rows, torch.from_numpy(here.numbers).to(DEVICE), normals.float(), paths.float())


def test_steps_are_those_of_the_processor(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = replace(GPU_LEARNING, batch=32, bfloat16=False, coarse_steps=0)
    here, there = batch_of(scene)
    learners: list[Any] = [Learner(network_of(scene), settings), GpuLearner(network_of(scene), settings)]
    learners[1]._turns.uniform_()
    lattice = learners[1]._uniform()
    monkeypatch.setattr(learners[1], "_uniform", lambda: lattice)
    monkeypatch.setattr("prt_bake.trainer.learning.learner.rotated_lattice", lambda *_: numpy_of(lattice))
    generator = np.random.default_rng(0)
    for share in np.linspace(0.1, 0.9, 8):
        for learner, batch in zip(learners, (here, there), strict=True):
            learner.learn(DRAWN, batch, float(share), generator)
    for name, expected in learners[0].model.state_dict().items():
        assert_allclose(numpy_of(learners[1].model.state_dict()[name]), numpy_of(expected), atol=2e-4, err_msg=name)


def test_uniform_directions_are_uniform(scene: Scene) -> None:
    learner = GpuLearner(network_of(scene), replace(GPU_LEARNING, batch=20_000))
    learner._turns.uniform_()
    directions = numpy_of(learner._uniform())
    assert_allclose(np.linalg.norm(directions, axis=2), 1.0, atol=1e-5)
    one = directions[:, 0]
    assert_allclose(one.mean(axis=0), 0.0, atol=4.5 / np.sqrt(3 * 20_000))
    assert_allclose(one.T @ one / 20_000, np.eye(3) / 3.0, atol=4.5 * 0.3 / np.sqrt(20_000))
    # Rotations keep the angles between the directions of the lattice.
    assert_allclose(np.einsum("qc,qc->q", one, directions[:, 5]), one[0] @ directions[0, 5], atol=1e-5)


def test_a_loss_that_is_not_finite_stops_the_training_with_its_query_and_leaves_finite_weights(scene: Scene) -> None:
    learner = GpuLearner(network_of(scene), replace(GPU_LEARNING, batch=32))
    _here, batch = batch_of(scene)
    broken = batch._replace(rows=batch.rows.clone(), numbers=batch.numbers + 100)
    broken.rows[5, -1] = torch.nan
    generator = np.random.default_rng(0)
    learner.learn(DRAWN, batch, 0.1, generator)
    learner.learn(DRAWN, broken, 0.1, generator)

    def learn_on() -> None:
        for _ in range(64):
            learner.learn(DRAWN, batch, 0.1, generator)

    with pytest.raises(QueryError, match="is not finite, caused by query 105"):
        learn_on()
    assert all(weights.isfinite().all() for weights in learner.model.parameters())


def test_a_loss_of_the_last_steps_that_is_not_finite_is_seen_at_the_end(scene: Scene) -> None:
    learner = GpuLearner(network_of(scene), replace(GPU_LEARNING, batch=32))
    _here, batch = batch_of(scene)
    broken = batch._replace(rows=batch.rows.clone())
    broken.rows[:, -1] = torch.nan
    for rows in (batch, batch, broken):
        learner.learn(DRAWN, rows, 0.1, np.random.default_rng(0))
    with pytest.raises(QueryError, match="is not finite, caused by query 31"):
        learner.check(DRAWN)


@pytest.mark.parametrize("batch", [3, 7])
def test_blocks_hold_whole_batches_and_no_row_is_left_out(scene: Scene, batch: int) -> None:
    stream = replace(STREAM, queries_a_batch=5, exits=1, kept=1)
    renderer = GpuRenderer(prepare(scene), box_of(scene), stream, 4, batch, "face", straight)
    renderer.start()
    numbers = np.concatenate([numpy_of(renderer.draw(batch).numbers) for _ in range(6)])
    renderer.stop()
    assert_array_equal(numbers, np.arange(6 * batch))


def test_rotations_depend_on_the_seed_and_are_new_at_each_step(scene: Scene) -> None:
    _here, batch = batch_of(scene)
    drawn = []
    for seed in (0, 0, 1):
        learner = GpuLearner(network_of(scene), replace(GPU_LEARNING, batch=32))
        generator = np.random.default_rng(seed)
        for _ in range(2):
            learner.learn(DRAWN, batch, 0.1, generator)
            drawn.append(numpy_of(learner._turns).copy())
    assert_array_equal(drawn[:2], drawn[2:4])
    assert not np.isclose(drawn[0], drawn[1]).any(axis=1).all()
    assert np.abs(drawn[0] - drawn[4]).max() > 0.1


def test_dark_walks_are_never_kept_with_a_weight_that_is_not_finite() -> None:
    throughput = torch.zeros((1, 3, 3), device=DEVICE)
    throughput[0, 0] = 0.3
    directions = torch.eye(3, device=DEVICE)[None]
    offsets = torch.full((1, 1), 1.0, dtype=torch.float64, device=DEVICE)
    _kept, light = resampled(directions, throughput, 2, offsets)
    assert light.isfinite().all()


@pytest.mark.parametrize("kinds", [(Learner, GpuLearner), (GpuLearner, Learner)])
def test_a_run_continues_on_the_other_device(scene: Scene, kinds: tuple[type[Learner], type[Learner]]) -> None:
    settings = replace(LearningSettings(), batch=32, bfloat16=False)
    batches = dict(zip((Learner, GpuLearner), batch_of(scene), strict=True))
    first, second = (kind(network_of(scene), settings) for kind in kinds)
    generator = np.random.default_rng(0)
    for _ in range(3):
        first.learn(DRAWN, batches[kinds[0]], 0.1, generator)
    state = first.state()
    for group in (group for values in state["optimizers"] for group in values["param_groups"]):
        # As a run on a GPU leaves them.
        group.update(lr=torch.tensor(0.1), capturable=True, foreach=True)
    second.restore(state)
    assert second.step == 3
    assert not any(group["capturable"] or torch.is_tensor(group["lr"]) for group in second._groups()) or REAL
    second.learn(DRAWN, batches[kinds[1]], 0.2, generator)
    assert second.step == 4
    assert all(weights.isfinite().all() for weights in second.model.parameters())
