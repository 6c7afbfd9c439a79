"""Baking: from a transport function and a mesh to an asset of transfer coefficients.

`a_lm(x, ωo) = ∫ Ŝ(ωi; x, ωo) Y_lm(ωi) dωi` at every vertex x and every view bin ωo of the hemisphere about its normal.
"""

import math
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bakers.plain_function import as_transport
from bakers.transport import on_mesh, prepared, refuse_foreign, transport_kind, up_to
from bakers.workers import Threads, Workers
from formats.asset import Asset
from formats.atomic import refuse_unwritable
from formats.errors import QueryError, refuse_path
from formats.mesh import Mesh
from formats.scene import Scene
from prt_bake.baking.adaptive.run import Run, bake_to_error
from prt_bake.baking.fixed_samples import bake_by_samples
from prt_bake.baking.job.arguments import as_light, as_point, refuse_unusable
from prt_bake.baking.job.effort import choose_effort
from prt_bake.baking.job.identity import identity_of
from prt_bake.baking.job.provenance import known_before
from prt_bake.baking.job.pruning_record import Light
from prt_bake.baking.job.views import warn_of_clamped_views
from prt_bake.baking.job.work import Progress, Work
from prt_bake.baking.lobes.in_bake import counting_lobes, plan_lobes_of_bake
from prt_bake.baking.output.checkpoint_store import CheckpointStore, open_checkpoint_store
from prt_bake.baking.output.pruned_sink import WronglyPruned
from prt_bake.baking.output.sink import asset_head
from prt_bake.baking.path_traced import PathTraced
from prt_bake.baking.plan import plan
from prt_bake.baking.pruning.pruning import ITEMS, choose_pruning
from prt_bake.jit.limits import limited_threads
from prt_bake.mathematics import sphere
from prt_bake.tracer.gpu.availability import require_walks_on

__all__ = ["ITEMS", "Light", "Progress", "bake", "choose_effort", "plan"]

JOURNAL_VERSION = 4
"""Changes with the names of the checkpoints and of their arrays."""


def bake(
    transport: Any,
    mesh: Mesh,
    degree: int = 2,
    rings: int = 16,
    sectors: int = 64,
    directions: str = "fibonacci",
    samples: int | None = None,
    error: float | None = None,
    seed: int = 0,
    *,
    minutes: float | None = None,
    out: str | Path | None = None,
    precision: str = "float32",
    storage: str = "float16",
    workers: int = 1,
    scheduler: str | None = None,
    device: str = "cpu",
    progress: Progress | None = None,
    stop: Callable[[], bool] | None = None,
    resume: bool = False,
    leave_out: Collection[str] = (),
    for_light: Light | ArrayLike | None = None,
    for_eye: ArrayLike | None = None,
    lobes: int = 0,
    provenance: dict[str, Any] | None = None,
) -> Asset:
    """Bakes `transport` at every vertex of `mesh` and at rings × sectors view bins.

    Args:
        transport: a network, a scene, which is path traced, a function f(incident [N,D,3], positions [N,3],
            outgoing [N,3]) → Ŝ [N,D,3], or an object that offers evaluate, evaluate_block or estimate_coefficients
            (`bakers.transport`). It gets NumPy arrays and may return NumPy arrays or torch tensors.
        mesh: in the transport's object space; a trimesh mesh too.
        degree: of the spherical harmonics, K = (degree + 1)².
        rings, sectors: view bins of the hemisphere about each vertex normal.
        directions: "fibonacci" (fitted by least squares), "sobol" or "uniform" (summed with equal weights).
        samples: directions per bin, or random walks if the transport estimates coefficients itself. Without samples,
            error and minutes the bake goes to an error of 2 %; with random walks it takes 64 samples, with other
            directions than "fibonacci" 64, or 2K if that is more.
        error: requested relative RMSE of the coefficients, of the object and of the 95th percentile of its vertices.
            With "fibonacci" directions the bake is adaptive (`prt_bake.baking.adaptive.run`): `samples` is ignored,
            each bin gets as many directions as it needs, and smooth bins are interpolated from their neighbours. With
            other directions and with random walks a pilot chooses `samples`.
        minutes: time in which the adaptive bake is refined, unless it reaches `error` earlier. A coarse asset is
            written first. math.inf: until it is stopped, or cannot be refined further.
        seed: keys all random numbers; equal seeds give equal assets for any number of workers.
        out: asset to write; without it the coefficients are a float32 array. Finished blocks are kept beside it, in
            OUT.journal, until it is complete.
        precision: "float32" or "bfloat16", of a network's matrix products.
        storage: "float16" or "float32", in the file.
        workers: threads; each bakes its own block of vertices, except that random walks share each block.
        scheduler: address of a `dask.distributed` scheduler whose workers bake the blocks (the extra `cluster`).
        device: where a network is evaluated ("cpu", "cuda"); `PathTraced(scene, "cuda")` path traces on a GPU.
        progress: called after each block.
        stop: called before each block; returning true ends the bake with a valid partial asset, as Ctrl-C does.
        resume: continue from the finished blocks of a stopped or killed bake of the same `out`, transport, mesh and
            arguments. The result is the same, bit for bit. Without such blocks the bake starts from the beginning.
        leave_out: items of "unseen", "duplicates", "views", "bands" and "channels" that may be pruned where they are
            redundant (`prt_bake.baking.pruning.pruning`); `baking.ITEMS` are all of them. Pruned axes have length 1,
            pruned vertices are not valid, and the asset's `left_out` lists each item.
        for_light: coefficients [K,3] of the only light that the asset is for; it then holds radiance, K = 1.
        for_eye: the only point [3] that the asset is seen from; B = 1 then.
        lobes: most lobes in a view, 0 to 4, for what lies beyond the harmonics (`formats.asset.lobes`); as many are
            found as gain something. They are added to the asset when it is complete. The command's default is 4.
        provenance: entries added to the asset's provenance (command, hashes, credits).

    Returns:
        The asset: coefficients [V,B,K,3], standard_error [V,B] (one sigma, rms over K and channels), tangents [V,3].
        After an early stop `complete` is false and the remaining vertices are not valid. Vertices where the transport
        returned values that are not finite are not valid either, and are listed in the provenance.

    Raises:
        QueryError: an argument out of its domain, a mesh outside the box of a network or off the surface of a path
            traced scene, a transport without a usable method or with values of another shape, an error out of reach, a
            transport that is finite nowhere, a bake that was stopped before its first vertex.
        StorageError: the asset cannot be written.
        ClusterError: the scheduler cannot be reached or has gone, its workers have other versions, or keep dying.

    Example:
        A matte sphere. Under constant light it sends out as much radiance as it receives:

        >>> import numpy as np, prt_bake as prt, trimesh
        >>> def matte(incident, positions, outgoing):
        ...     cosine = np.maximum(np.einsum("ndi,ni->nd", incident, positions), 0.0)
        ...     return np.repeat(cosine[..., None] / np.pi, 3, axis=-1)
        >>> sphere = trimesh.creation.icosphere(subdivisions=0)
        >>> mesh = prt.Mesh(sphere.vertices, sphere.faces.astype(np.int32), sphere.vertex_normals)
        >>> asset = prt.bake(matte, mesh, degree=2, rings=1, sectors=4, samples=256)
        >>> asset.coefficients.shape
        (12, 4, 9, 3)
        >>> constant_light = np.zeros((9, 3))
        >>> constant_light[0] = np.sqrt(4.0 * np.pi)
        >>> np.allclose(prt.shade(asset, constant_light, [0.0, 0.0, 4.0]), 1.0, atol=0.01)
        True
    """
    began = time.monotonic()
    refuse_path("transport", transport, "prt.load_model")
    refuse_path("mesh", mesh, "prt.read_mesh")
    if isinstance(transport, Scene):
        require_walks_on(device)
        transport = PathTraced(transport, "cpu" if device == "cpu" else "cuda")
    transport = as_transport(transport)
    refuse_unusable(
        mesh, degree=degree, rings=rings, sectors=sectors, samples=samples, error=error, minutes=minutes, seed=seed,
        workers=workers, leave_out=leave_out, lobes=lobes, directions=directions, precision=precision, storage=storage,
    )  # fmt: skip
    if out is not None:
        refuse_unwritable(out)
    refuse_foreign(transport, mesh)
    warn_of_clamped_views(mesh, rings, sectors)
    whole = on_mesh(transport, mesh)
    transport = prepared(up_to(whole, degree), precision, device)
    effort = choose_effort(transport, degree, directions, samples, error, minutes)
    error = effort.error
    if resume and out is None:
        raise QueryError("resume: expected out, the file of the stopped bake, found none; give out")
    light = as_light(for_light, degree)
    eye = None if for_eye is None else as_point(for_eye)
    arguments: dict[str, Any] = {
        "degree": degree,
        "rings": rings,
        "sectors": sectors,
        "error": error,
        "seed": seed,
        "precision": precision,
        "storage": storage,
        "device": getattr(transport, "device", device),
        "leave_out": sorted(leave_out),
        "for_light": None if light is None else light.content_hash,
        "for_eye": None if eye is None else eye.tolist(),
        "lobes": lobes,
    }
    # An adaptive bake chooses its own directions.
    arguments |= {"minutes": minutes} if effort.adaptive else {"directions": directions, "samples": effort.samples}
    transport_hash, evaluations = ("", 0) if out is None else identity_of(transport, mesh, provenance or {})
    identity = {**arguments, "mesh": mesh.content_hash, "transport": transport_hash, "journal_version": JOURNAL_VERSION}
    # Blocks do not depend on the time, so that a bake can be resumed with another one.
    identity |= {} if minutes is None else {"minutes": "any"}
    tangents = sphere.tangent_frame(mesh.normals)
    head = asset_head(mesh, tangents, rings, sectors, degree, transport)
    report = known_before(transport, mesh, arguments, workers) | (provenance or {})
    with (
        limited_threads(transport, workers),
        closing(open_checkpoint_store(out, identity, resume)) as store,
        open_workers(transport, workers, scheduler) as pool,
    ):
        prunable = set(leave_out) - _items_needed(store)
        while True:
            pruning = choose_pruning(
                transport, mesh, degree, rings, sectors, error=error, seed=seed, prunable=prunable, light=light, eye=eye
            )
            evaluations += pruning.evaluations
            work = Work(
                transport, mesh, pruning, head, report, out, storage, pool, seed, progress, stop, began, evaluations
            )
            planned = plan_lobes_of_bake(transport, whole, head, pruning, lobes, minutes, pool.count, precision, device)
            work.report = report | {"lobes": planned.entry_before}
            work.progress = counting_lobes(progress, planned.seconds)
            try:
                if effort.adaptive:
                    deadline = math.inf if minutes is None else began + 60.0 * minutes - planned.seconds
                    asset = bake_to_error(Run(work, store, error, deadline))
                else:
                    asset = bake_by_samples(work, store, directions, effort.samples, error)
            except WronglyPruned as wrong:
                prunable, evaluations = prunable - {wrong.item}, work.evaluations
                report = report | {"needed_after_all": [*report.get("needed_after_all", []), str(wrong)]}
                store.forget("")
                store.write("needed", {"items": np.array(sorted(set(leave_out) - prunable))})
                continue
            lobed = planned.add_to(asset, work, store) if work.finished else None
            if lobed is None:
                return asset
            store.remove()
            return lobed


@contextmanager
def open_workers(transport: Any, workers: int, scheduler: str | None) -> Iterator[Workers]:
    """Threads, or the workers of a scheduler. Random walks use all threads of a process for one block."""
    exclusive = transport_kind(transport) == "coefficients"
    if scheduler is None:
        yield Threads(1 if exclusive else workers)
        return
    if workers != 1:
        raise QueryError(f"workers: expected 1 with a scheduler, found {workers}; give workers or a scheduler")
    from prt_bake.baking.cluster import open_cluster

    with open_cluster(scheduler, exclusive) as pool:
        yield pool


def _items_needed(store: CheckpointStore) -> set[str]:
    """Items that an earlier run could not prune."""
    arrays = store.read("needed")
    return set() if arrays is None else set(arrays["items"].tolist())
