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

from bakers.transport import on_mesh, prepared, refuse_foreign, up_to, way_in
from bakers.workers import Crew, Threads
from formats.asset import Asset
from formats.atomic import refuse_unwritable
from formats.errors import QueryError, refuse_path
from formats.mesh import Mesh
from prt_bake.baking.adaptive.run import Run, bake_to_error
from prt_bake.baking.fixed_samples import bake_by_samples
from prt_bake.baking.job.arguments import refuse_unusable
from prt_bake.baking.job.identity import identity_of
from prt_bake.baking.job.pruning_record import Light
from prt_bake.baking.job.work import Progress, Work
from prt_bake.baking.output.checkpoint import Store, opened_store
from prt_bake.baking.output.pruned_sink import NotSo
from prt_bake.baking.output.sink import asset_head, said_by
from prt_bake.baking.plan import plan
from prt_bake.baking.pruning.pruning import ITEMS, as_light, as_point, needs_of
from prt_bake.jit.limits import limited_threads
from prt_bake.mathematics import sphere

__all__ = ["ITEMS", "Light", "Progress", "bake", "plan", "said_by"]


def bake(
    transport: Any,
    mesh: Mesh,
    degree: int = 2,
    rings: int = 16,
    sectors: int = 64,
    directions: str = "fibonacci",
    samples: int = 64,
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
    provenance: dict[str, Any] | None = None,
) -> Asset:
    """Bakes `transport` at every vertex of `mesh` and every one of rings × sectors view bins.

    Args:
        transport: offers evaluate, evaluate_block or estimate_coefficients (`bakers.transport`); it is handed NumPy
            arrays and may answer in NumPy or torch.
        mesh: what is baked, in the transport's object space.
        degree: of the spherical harmonics, K = (degree + 1)².
        rings, sectors: view bins of the hemisphere about each vertex normal.
        directions: "fibonacci" (fitted by least squares), "sobol" or "uniform" (summed with equal weights).
        samples: directions per bin, or random walks if the transport estimates coefficients itself. 64, the default,
            is raised to 2K where that is more.
        error: estimated relative RMSE of the coefficients to reach, of the object and of the 95th percentile of its
            vertices. With "fibonacci" directions `samples` is not used then: each view bin is evaluated in as many
            directions as it takes, and only where its neighbours do not tell it (`prt_bake.baking.adaptive.run`).
            Otherwise, and for random walks, a pilot tells how many `samples` it takes.
        minutes: how long to go on making it finer, if `error` is not reached before; a coarse asset is there first.
            math.inf: until it is stopped, or cannot be made finer.
        seed: keys everything random; equal seeds give equal assets whatever the number of workers.
        out: asset to write; without it the coefficients are an array in float32. Finished blocks lie beside it, in
            OUT.journal, until it is whole.
        precision: "float32" or "bfloat16", of a network's matrix work.
        storage: "float16" or "float32", in the file.
        workers: threads, each with a block of vertices of its own; those of random walks share each block.
        scheduler: address of a `dask.distributed` scheduler, whose workers do the blocks then (the extra `cluster`).
        device: where a network is evaluated ("cpu", "cuda").
        progress: called after each block.
        stop: asked before each block; answering true ends the bake with a valid partial asset, as Ctrl-C does.
        resume: go on from the finished blocks of a bake to the same `out` that was stopped or killed, asked for the
            same of the same transport and mesh: to the same numbers, bit for bit.
        leave_out: of "unseen", "duplicates", "views", "bands" and "channels", what may be left out where the scene does
            not need it (`prt_bake.baking.pruning.pruning`); `baking.ITEMS` are all of them. Axes that are left out have
            length 1, vertices that are left out are not valid, and `left_out` of the asset names each.
        for_light: coefficients [K,3] of the only light that the asset is for; it holds radiance then, K = 1.
        for_eye: the only point [3] that it will be seen from; B = 1 then.
        provenance: entries added to the asset's provenance (command, hashes, credits).

    Returns:
        The asset: coefficients [V,B,K,3], standard_error [V,B] (one sigma, rms over K and channels), tangents [V,3].
        Where the bake was stopped, complete is false and the vertices left are not valid. Vertices at which the
        transport answered something that is not finite are not valid and are named in provenance.

    Raises:
        QueryError: an argument out of its domain, a mesh outside the box that a network was trained in or off the
            surface of the scene that is path traced, a transport
            that offers nothing or answers in another shape, an error that cannot be reached, a transport that is finite
            nowhere, a bake that was stopped before its first vertex.
        StorageError: the asset cannot be written.
        ClusterError: the scheduler cannot be reached or has gone, its workers are not fit, or died over and over.
    """
    began = time.monotonic()
    refuse_path("transport", transport, "prt.load_model")
    refuse_path("mesh", mesh, "prt.read_mesh")
    refuse_unusable(
        mesh, degree=degree, rings=rings, sectors=sectors, samples=samples, error=error, minutes=minutes, seed=seed,
        workers=workers, leave_out=leave_out, directions=directions, precision=precision, storage=storage,
    )  # fmt: skip
    if out is not None:
        refuse_unwritable(out)
    refuse_foreign(transport, mesh)
    transport = prepared(up_to(on_mesh(transport, mesh), degree), precision, device)
    refined = directions == "fibonacci" and way_in(transport) != "coefficients"
    if minutes is not None and not refined:
        raise QueryError(
            "minutes: they are for fibonacci directions and transports that answer Ŝ; give samples or an error instead"
        )
    refined = refined and (error is not None or minutes is not None)
    if resume and out is None:
        raise QueryError("resume: finished blocks lie beside the asset; give out, the file that was being written")
    light = as_light(for_light, degree)
    eye = None if for_eye is None else as_point(for_eye)
    asked: dict[str, Any] = {
        "degree": degree,
        "rings": rings,
        "sectors": sectors,
        "error": error,
        "seed": seed,
        "precision": precision,
        "storage": storage,
        "device": device,
        "leave_out": sorted(leave_out),
        "for_light": None if light is None else light.content_hash,
        "for_eye": None if eye is None else eye.tolist(),
    }
    # How many directions there are is found out by a bake to an error, and how long it has is no matter of its numbers.
    asked |= {"minutes": minutes} if refined else {"directions": directions, "samples": samples}
    known, spent = ("", 0) if out is None else identity_of(transport, mesh, provenance or {})
    identity = {**asked, "mesh": mesh.content_hash, "transport": known}
    tangents = sphere.tangent_frame(mesh.normals)
    head = asset_head(mesh, tangents, rings, sectors, degree, transport)
    report = _settings(transport, mesh, asked, workers) | (provenance or {})
    with (
        limited_threads(transport, workers),
        closing(opened_store(out, identity, resume)) as store,
        opened_crew(transport, workers, scheduler) as crew,
    ):
        spared = set(leave_out) - _needed_after_all(store)
        while True:
            needs = needs_of(transport, mesh, degree, rings, sectors, error, seed, spared, light, eye)
            spent += needs.evaluations
            work = Work(transport, mesh, needs, head, report, out, storage, crew, seed, progress, stop, began, spent)
            try:
                if refined:
                    deadline = math.inf if minutes is None else began + 60.0 * minutes
                    return bake_to_error(Run(work, store, error, deadline))
                return bake_by_samples(work, store, directions, samples, error)
            except NotSo as wrong:
                spared, spent = spared - {wrong.item}, work.evaluations
                report = report | {"needed_after_all": [*report.get("needed_after_all", []), str(wrong)]}
                store.forget("")
                store.write("needed", {"items": np.array(sorted(set(leave_out) - spared))})


@contextmanager
def opened_crew(transport: Any, workers: int, scheduler: str | None) -> Iterator[Crew]:
    """Threads, or the workers of a scheduler; random walks share the threads of each process."""
    alone = way_in(transport) == "coefficients"
    if scheduler is None:
        yield Threads(1 if alone else workers)
        return
    if workers != 1:
        raise QueryError("workers: those of the scheduler do the work; give workers or a scheduler")
    from prt_bake.baking.cluster import opened_cluster

    with opened_cluster(scheduler, alone) as crew:
        yield crew


def _needed_after_all(store: Store) -> set[str]:
    """Items that an earlier run has found out are needed."""
    arrays = store.read("needed")
    return set() if arrays is None else set(arrays["items"].tolist())


def _settings(transport: Any, mesh: Mesh, asked: dict[str, Any], workers: int) -> dict[str, Any]:
    """Provenance that is known before the bake."""
    settings = {name: value for name, value in asked.items() if name not in ("seed", "device")}
    return {
        "settings": {**settings, "workers": workers},
        "seed": asked["seed"],
        "device": asked["device"],
        "mesh_sha256": mesh.content_hash,
        **_said_of(transport),
    }


def _said_of(transport: Any) -> dict[str, Any]:
    roughness = said_by(transport, "roughness", None)
    return {
        "transport": type(transport).__name__,
        "eta": float(said_by(transport, "eta", 1.0)),
        **({} if roughness is None else {"roughness": float(np.mean(roughness))}),
        "model": dict(getattr(transport, "metadata", None) or {}),
    }
