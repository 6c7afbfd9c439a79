"""Baking: from a transport function and a mesh to an asset of transfer coefficients.

`a_lm(x, ωo) = ∫ Ŝ(ωi; x, ωo) Y_lm(ωi) dωi` at every vertex x and every view bin ωo of the hemisphere about its normal.
"""

import hashlib
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bakers.baker import Block, bake_block, bake_blocks, block_size
from bakers.path_traced import Account, Walks
from bakers.plan import BakePlan, plan_bake
from bakers.transport import on_mesh, up_to, way_in
from formats.asset import Asset
from formats.errors import QueryError
from formats.mesh import Mesh
from prt_bake import sh
from prt_bake.bake_error import ErrorMeter
from prt_bake.bake_first_look import Site, first_refinement
from prt_bake.bake_job import Job, limited_threads, prepared, refuse_foreign, resolve, views_of
from prt_bake.bake_output import Sink, asset_head, open_sink, said_by
from prt_bake.bake_pilot import reach
from prt_bake.bake_refined import aimed
from prt_bake.bake_to_error import Run, bake_to_error, opened_store

Progress = Callable[[int, int, tuple[float, float, float]], None]
"""progress(vertices done, vertices in all, (seconds, evaluations, estimated relative error))."""

ROWS = 100


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
    device: str = "cpu",
    progress: Progress | None = None,
    stop: Callable[[], bool] | None = None,
    resume: bool = False,
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
            directions as it takes, and only where its neighbours do not tell it (`prt_bake.bake_to_error`). Otherwise,
            and for random walks, a pilot tells how many `samples` it takes.
        minutes: how long to go on making it finer, if `error` is not reached before; a coarse asset is there first.
        seed: keys everything random; equal seeds give equal assets whatever the number of workers.
        out: asset to write while baking; without it the coefficients are an array in float32.
        precision: "float32" or "bfloat16", of a network's matrix work.
        storage: "float16" or "float32", in the file.
        workers: threads, each with a block of vertices of its own; those of random walks share each block.
        device: where a network is evaluated ("cpu", "cuda").
        progress: called after each block.
        stop: asked before each block; answering true ends the bake with a valid partial asset, as Ctrl-C does.
        resume: go on from the finished blocks of a bake to the same `error` and `out` that was killed.
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
    """
    began = time.monotonic()
    refuse_foreign(transport, mesh)
    transport = prepared(up_to(on_mesh(transport, mesh), degree), precision, device)
    refined = directions == "fibonacci" and way_in(transport) != "coefficients"
    if minutes is not None and not (refined and minutes > 0.0):
        raise QueryError(
            "minutes: must be positive, and are for fibonacci directions and transports that answer Ŝ; "
            "give samples or an error instead"
        )
    if refined and (error is not None or minutes is not None):
        asked: dict[str, Any] = {
            "degree": degree,
            "rings": rings,
            "sectors": sectors,
            "error": error,
            "minutes": minutes,
            "seed": seed,
        }
        asked |= {"precision": precision, "storage": storage, "device": device}
        with limited_threads(transport, workers):
            return _refined(transport, mesh, asked, out, workers, progress, stop, resume, provenance or {}, began)
    if resume:
        raise QueryError("resume: is for a bake to an error, with fibonacci directions; this one starts anew")
    with limited_threads(transport, workers):
        job = resolve(transport, mesh, degree, rings, sectors, directions, samples, seed)
        spent = 0
        if error is not None:
            job, spent = reach(job, error, directions, seed)
        report = _settings(job, seed, precision, storage, workers, device, error) | (provenance or {})
        head = asset_head(mesh, job.tangents, rings, sectors, degree, transport)
        with open_sink(out, head, storage) as sink:
            return _run(job, sink, report, began, spent, workers, progress, stop)


def _refined(
    transport: Any,
    mesh: Mesh,
    asked: dict[str, Any],
    out: str | Path | None,
    workers: int,
    progress: Progress | None,
    stop: Callable[[], bool] | None,
    resume: bool,
    provenance: dict[str, Any],
    began: float,
) -> Asset:
    """Bakes to `asked["error"]`, for `asked["minutes"]`, in passes."""
    error, minutes, seed = asked["error"], asked["minutes"], asked["seed"]
    if error is not None and not 0.0 < error < 1.0:
        raise QueryError(f"error must be a relative RMSE between 0 and 1, found {error}")
    rings, sectors, degree = asked["rings"], asked["sectors"], asked["degree"]
    tangents, views = views_of(mesh, rings, sectors)
    site = Site(transport, mesh, tangents, views, rings, sectors, degree, seed)
    head = asset_head(mesh, tangents, rings, sectors, degree, transport)
    settings = {name: value for name, value in asked.items() if name not in ("seed", "device")}
    report = {
        "settings": {**settings, "directions": "extensible lattice", "workers": workers},
        "seed": seed,
        "device": asked["device"],
        "error_estimate": "independent directions at bins drawn at random",
        "mesh_sha256": mesh.content_hash,
        **_said_of(transport),
        **provenance,
    }
    identity = {**asked, "mesh": mesh.content_hash, "transport": _identity(transport, provenance)}
    run = Run(
        site=site,
        head=head,
        report=report,
        store=opened_store(out, identity, resume),
        out=out,
        storage=asked["storage"],
        workers=workers,
        error=error,
        deadline=math.inf if minutes is None else began + 60.0 * minutes,
        began=began,
        progress=progress,
        stop=stop,
    )
    return bake_to_error(run)


def _identity(transport: Any, provenance: dict[str, Any]) -> str:
    """What a resumed bake must have been begun with: the hash of the source file, or what is known of the transport."""
    if "source_sha256" in provenance:
        return str(provenance["source_sha256"])
    network = getattr(transport, "network", transport)
    if not hasattr(network, "state_dict"):
        return type(transport).__name__
    digest = hashlib.sha256()
    for name, tensor in network.state_dict().items():
        digest.update(name.encode() + tensor.detach().cpu().numpy().tobytes())
    return digest.hexdigest()


def plan(
    transport: Any,
    mesh: Mesh,
    degree: int = 2,
    rings: int = 16,
    sectors: int = 64,
    directions: str = "fibonacci",
    samples: int = 64,
    seed: int = 0,
    *,
    error: float | None = None,
    precision: str = "float32",
    storage: str = "float16",
    workers: int = 1,
    device: str = "cpu",
) -> BakePlan:
    """What `bake` with these arguments would cost; one block, or the pilot of a bake to an error, is baked to estimate
    it. Raises as `bake` does.
    """
    refuse_foreign(transport, mesh)
    transport = prepared(up_to(on_mesh(transport, mesh), degree), precision, device)
    vertices, width = len(mesh.positions), 2 if storage == "float16" else 4
    if error is not None and directions == "fibonacci" and way_in(transport) != "coefficients":
        with limited_threads(transport, workers):
            tangents, views = views_of(mesh, rings, sectors)
            site = Site(transport, mesh, tangents, views, rings, sectors, degree, seed)
            aim = aimed(site, first_refinement(site)[0], error)
        a_bin = math.ceil(aim.evaluations_per_vertex / site.bins)
        sizes = plan_bake(vertices, site.bins, sh.count(degree), a_bin, width)
        evaluations = round(aim.evaluations_per_vertex * vertices)
        return replace(sizes, evaluations=evaluations, seconds=aim.seconds * vertices / max(1, workers))
    with limited_threads(transport, workers):
        job = resolve(transport, mesh, degree, rings, sectors, directions, samples, seed)
        bake_block(job.task, 0, 1)
        size = min(block_size(job.task), vertices)
        shared = 1 if isinstance(job.resolved.sampling, Walks) else max(1, workers)
        began = time.monotonic()
        bake_block(job.task, 0, size)
        seconds = (time.monotonic() - began) * vertices / (size * shared)
    sizes = plan_bake(vertices, rings * sectors, sh.count(degree), job.resolved.samples, width)
    return replace(sizes, seconds=seconds)


def _run(
    job: Job,
    sink: Sink,
    report: dict[str, Any],
    began: float,
    spent: int,
    workers: int,
    progress: Progress | None,
    stop: Callable[[], bool] | None,
) -> Asset:
    """Bakes block by block into the sink, keeps the error figures, and closes the asset, whole or in part."""
    vertices = len(job.mesh.positions)
    per_vertex = job.rings * job.sectors * job.resolved.samples
    meter, rows, invalid, account = ErrorMeter(), list[tuple[float, float, float]](), list[int](), Account()
    done = bent = 0
    blocks = bake_blocks(job.task, range(vertices), workers)
    try:
        for block in _until(stop, blocks):
            sink.write(block)
            done, bent = block.first_vertex + len(block.valid), bent + block.bent
            invalid += (block.first_vertex + np.flatnonzero(~block.valid)).tolist()
            account += block.account or Account()
            meter.add(block)
            row = (time.monotonic() - began, float(spent + done * per_vertex), meter.total)
            if not rows or done * ROWS // vertices > len(rows) or done == vertices:
                rows.append(row)
            if progress is not None:
                progress(done, vertices, row)
    except KeyboardInterrupt:
        pass
    finally:
        blocks.close()
    if done == 0:
        raise QueryError("the bake was stopped before its first vertex was done; nothing was written")
    if len(invalid) == done:
        raise QueryError(f"the transport answered values that are not finite at every one of {done} vertices")
    report |= {
        "evaluations": spent + done * per_vertex,
        "seconds": time.monotonic() - began,
        "estimated_relative_rmse": {"total": meter.total, "percentile_95_over_vertices": meter.percentile_95},
        "bins_bent_to_the_horizon": bent,
        "vertices_not_finite": {"count": len(invalid), "first": invalid[:16]},
        "vertices_baked": done,
    }
    if isinstance(job.resolved.sampling, Walks):
        report["walks"] = account.as_json()
    return sink.finish(report, np.array(rows, dtype=np.float64).reshape(-1, 3), complete=done == vertices)


def _until(stop: Callable[[], bool] | None, blocks: Iterator[Block]) -> Iterator[Block]:
    while not (stop is not None and stop()):
        block = next(blocks, None)
        if block is None:
            return
        yield block


def _settings(
    job: Job, seed: int, precision: str, storage: str, workers: int, device: str, error: float | None
) -> dict[str, Any]:
    """Provenance that is known before the bake."""
    return {
        "settings": {
            "degree": job.degree,
            "rings": job.rings,
            "sectors": job.sectors,
            "directions": job.resolved.directions,
            "samples": job.resolved.samples,
            "error": error,
            "precision": precision,
            "storage": storage,
            "workers": workers,
        },
        "seed": seed,
        "device": device,
        "error_estimate": job.resolved.error_estimate,
        "condition_number": job.resolved.condition,
        "mesh_sha256": job.mesh.content_hash,
        **_said_of(job.transport),
    }


def _said_of(transport: Any) -> dict[str, Any]:
    return {
        "transport": type(transport).__name__,
        "eta": float(said_by(transport, "eta", 1.0)),
        "model": dict(getattr(transport, "metadata", None) or {}),
    }
