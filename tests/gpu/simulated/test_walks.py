"""The path tracer on a GPU walks as on the processor: in numba's simulator, or on a GPU if there is one."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from formats.errors import QueryError
from formats.scene import Scene, read_scene
from prt_bake.baking.path_traced import PathTraced
from prt_bake.tracer.estimate import estimate_coefficients
from prt_bake.tracer.gpu import availability, exits
from prt_bake.tracer.gpu.device_functions import cuda
from prt_bake.tracer.prepared import KernelQueries, prepare
from prt_bake.trainer.samples.queries import QuerySource
from prt_bake.trainer.samples.rows import trace_exits
from tests.tracer.nested_scenes import nested_scene
from tests.tracer.scenes import lumpy, make_scene, moved, sphere, with_uv

ROUNDING = 2e-5
QUERIES, WALKS = 6, 4
SCENES_FOLDER = Path(__file__).parents[3] / "scenes"
GRID = np.random.default_rng(1).uniform(1.0, 9.0, (4, 5, 6))
PEAKS = np.where(GRID > 8.0, 900.0, 1.0)


def nested(folder: Path) -> Scene:
    """A rough object with a texture of roughness that contains a diffuse ball with a texture and a ball of glass."""
    seed = {"mesh": with_uv(moved(sphere(1), 0.3, 0.3)), "name": "seed", "surface": "diffuse"}
    seed["reflectance"] = np.linspace(0.1, 0.9, 48).reshape(4, 4, 3)
    glass = {"mesh": moved(sphere(1), 0.25, -0.3), "name": "glass", "interface": {"eta": 1.6, "roughness": 0.0}}
    glass["medium"] = {"sigma_t": 0.5, "albedo": 0.7}
    rough = np.linspace(0.1, 0.4, 16).reshape(4, 4)
    return nested_scene(
        folder, with_uv(sphere(2)), {"sigma_t": 2.0, "albedo": 0.9}, (seed, glass), eta=1.35, roughness=rough
    )


CASES: dict[str, Callable[[Path], Scene]] = {
    "rough": lambda at: make_scene(at, lumpy(2), eta=1.4, roughness=0.2, sigma_t=8.0, phase_g=0.4),
    "smooth": lambda at: make_scene(at, lumpy(2), eta=1.5, sigma_t=1.0, albedo=[0.9, 0.5, 0.99]),
    "matched": lambda at: make_scene(at, lumpy(2), sigma_t=3.0),
    "vertex normals": lambda at: make_scene(at, sphere(1), "vertex", eta=1.4, roughness=0.3, sigma_t=30.0),
    "extinction by channel": lambda at: make_scene(at, lumpy(2), eta=1.3, roughness=0.3, sigma_t=[1.0, 2.0, 7.0]),
    "grid": lambda at: make_scene(at, lumpy(2), eta=1.3, roughness=0.3, sigma_t=GRID, albedo=GRID / 9.0),
    "grid with peaks": lambda at: make_scene(at, lumpy(2), sigma_t=PEAKS),
    "grid by channel": lambda at: make_scene(at, lumpy(2), sigma_t=np.stack([GRID, 2.0 * GRID, GRID**2], axis=-1)),
    "nested": nested,
    "drink": lambda at: read_scene(SCENES_FOLDER / "drink" / "drink.toml"),
    "compensated": lambda at: read_scene(SCENES_FOLDER / "grape" / "grape_compensated.toml"),
}


@pytest.mark.parametrize("name", CASES)
def test_walks_are_those_of_the_processor(name: str, tmp_path: Path) -> None:
    prepared = prepare(CASES[name](tmp_path))
    source = QuerySource(prepared, 1, 3, 0.5)
    queries = source.draw(0, QUERIES)
    here = trace_exits(prepared, source, queries, WALKS, 5)
    arrays = KernelQueries._make(map(cuda.to_device, source.for_kernel(queries)))
    there = exits.new_exits(QUERIES, WALKS)
    exits.on_gpu(prepared).draw(arrays, cuda.to_device(np.zeros(QUERIES, np.int64)), 5, there)
    throughput, directions = there.throughput.copy_to_host(), there.directions.copy_to_host()
    lit = here.throughput.any(axis=-1)
    assert lit.sum() > WALKS
    assert_allclose(throughput, here.throughput, atol=ROUNDING)
    assert_allclose(directions[lit], here.directions[lit], atol=ROUNDING)
    assert_array_equal(there.scattered.copy_to_host() == 0, here.unscattered)


def test_estimates_are_those_of_the_processor_for_chunks_of_any_length(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = make_scene(tmp_path, lumpy(2), eta=1.4, roughness=0.3, sigma_t=1.0, albedo=0.7)
    queries = QuerySource(prepare(scene), 1, 3).draw(0, 3)
    monkeypatch.setattr("prt_bake.tracer.estimate._PATHS_PER_CHUNK", 5)
    monkeypatch.setattr(exits, "_WALKS_AT_ONCE", 10)
    keys = np.array([7, 8, 2**40], np.uint64)

    def estimate(device: str) -> object:
        return estimate_coefficients(
            scene, queries.location.positions, queries.outgoing, 3, 12, seed=2, keys=keys, device=device
        )

    here, there = estimate("cpu"), estimate("cuda")
    for name in ("mean", "standard_error", "unscattered", "lost"):
        expected = getattr(here, name)
        assert_allclose(getattr(there, name), expected, atol=ROUNDING, err_msg=name)
    assert np.abs(here.mean).max() > 0.01


def test_blocks_of_a_path_traced_bake_are_those_of_the_processor(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, lumpy(2), eta=1.4, roughness=0.3, sigma_t=1.0, albedo=0.7)
    positions, normals = scene.mesh.positions[:2], scene.mesh.normals[:2]
    outgoing = np.stack([normals, normals], axis=1)
    here, there = (
        PathTraced(scene, device).estimate_block(positions, outgoing, 1, 6, [1, 2]) for device in ("cpu", "cuda")
    )
    assert_allclose(there.mean, here.mean, atol=ROUNDING)
    assert np.abs(here.mean).max() > 0.01


def test_lost_light_is_reported(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, sphere(1), sigma_t=20.0, albedo=1.0)
    prepared = prepare(scene)
    prepared.boundary = prepared.boundary._replace(most_events=3)
    queries = QuerySource(prepared, 1, 3).draw(0, 2)
    there = estimate_coefficients(scene, queries.location.positions, queries.outgoing, 1, 8, device="cuda")
    here = estimate_coefficients(scene, queries.location.positions, queries.outgoing, 1, 8)
    assert here.lost.min() > 0.0
    assert_allclose(there.lost, here.lost, atol=ROUNDING)


def test_degrees_beyond_the_kernels_are_refused(tmp_path: Path) -> None:
    scene = make_scene(tmp_path, sphere(1))
    queries = QuerySource(prepare(scene), 1, 3).draw(0, 1)
    with pytest.raises(QueryError, match="degree: expected at most 7 on a GPU, found 8"):
        estimate_coefficients(scene, queries.location.positions, queries.outgoing, 8, 8, device="cuda")


def test_a_gpu_that_cannot_walk_is_refused_with_the_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = make_scene(tmp_path, sphere(1))
    queries = QuerySource(prepare(scene), 1, 3).draw(0, 1)
    monkeypatch.setattr(availability, "_add_one", lambda numbers: 1 / 0)
    availability.reason_against.cache_clear()
    try:
        with pytest.raises(QueryError, match="paths cannot be traced on a GPU: numba-cuda fails"):
            estimate_coefficients(scene, queries.location.positions, queries.outgoing, 1, 8, device="cuda")
    finally:
        availability.reason_against.cache_clear()
