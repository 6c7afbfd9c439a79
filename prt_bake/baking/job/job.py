"""A bake with everything resolved: where, in which bins and basis, how the light is sampled."""

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bakers.baker import Sampling, Task
from bakers.horizon import VertexFaces, bend_to_horizon, faces_about
from bakers.path_traced import Walks
from bakers.transport import way_in
from formats.errors import QueryError
from formats.mesh import Mesh
from prt_bake.baking.job.sampling import Resolved, resolve_sampling
from prt_bake.mathematics import sphere
from prt_bake.mathematics.view_frames import frames_of

if TYPE_CHECKING:
    from prt_bake.baking.pruning.pruning import Needs

OUTSIDE = 0.01
"""How far a mesh may leave the model's box, in sides of it."""

MOST_BINS = 1 << 16

Views = Callable[[int, int], tuple[NDArray[np.float64], int]]
"""(first vertex, last vertex) → directions to the eye [n,B,3] and how many of them were bent to the horizon."""


@dataclass(frozen=True)
class Job:
    """Everything resolved: where, in which bins and basis, how."""

    transport: Any
    mesh: Mesh
    rings: int
    sectors: int
    degree: int
    resolved: Resolved
    task: Task
    needs: "Needs | None" = None

    @property
    def vertices(self) -> NDArray[np.int64]:
        """Numbers of those that are baked."""
        return np.arange(len(self.mesh.positions)) if self.needs is None else self.needs.vertices


def resolve(
    transport: Any,
    mesh: Mesh,
    degree: int,
    rings: int,
    sectors: int,
    directions: str,
    samples: int,
    seed: int,
    needs: "Needs | None" = None,
) -> Job:
    """Raises QueryError for arguments out of their domain. `needs`: what of it all is baked, everything by default."""
    outgoing, bins, around = views_of(mesh, rings, sectors)[1], rings * sectors, sectors
    if needs is not None and needs.views != "all":
        outgoing, bins, around = needs.outgoing, len(needs.local), 1
    resolved = resolve_sampling(transport, degree, bins, around, directions, samples, seed)
    sampling = resolved.sampling
    if needs is not None and needs.views == "one" and not isinstance(sampling, Walks):
        sampling = alike(sampling)
    task = Task(transport, mesh.positions, outgoing, bins, around, sampling, frames_of(mesh))
    return Job(transport, mesh, rings, sectors, degree, resolved, task, needs)


def alike(sampling: Sampling) -> Sampling:
    """All bins of a vertex lit from the same directions: what they differ by is no noise."""

    def of_first(rotation: Callable[[int, int], NDArray[np.int64]]) -> Callable[[int, int], NDArray[np.int64]]:
        return lambda first, last: np.broadcast_to(rotation(first, last)[:, :1], rotation(first, last).shape)

    second = None if sampling.second_rotation is None else of_first(sampling.second_rotation)
    return replace(sampling, rotation=of_first(sampling.rotation), second_rotation=second)


def views_of(mesh: Mesh, rings: int, sectors: int) -> tuple[NDArray[np.float64], Views]:
    """Tangents [V,3], and the directions of the view bins, bent to the horizon where they lie below it. Raises
    QueryError for more bins than are possible.
    """
    if rings * sectors > MOST_BINS:
        raise QueryError(f"rings × sectors: {rings} × {sectors} view bins, where at most {MOST_BINS:,} are possible")
    local = sphere.view_bins(rings, sectors)
    tangents = sphere.tangent_frame(mesh.normals)
    around = horizons(mesh)

    def outgoing(first: int, last: int) -> tuple[NDArray[np.float64], int]:
        world = sphere.to_world(local, mesh.normals[first:last, None], tangents[first:last, None])
        return bend_to_horizon(world, around, first)

    return tangents, outgoing


def horizons(mesh: Mesh) -> VertexFaces:
    """The faces around each vertex; vertices at one place with one normal have them in common, as one point has."""
    return faces_about(np.concatenate([mesh.positions, mesh.normals], axis=1), mesh.faces, mesh.face_normals)


def refuse_foreign(transport: Any, mesh: Mesh) -> None:
    """Raise QueryError where the mesh is not the transport's own: where it leaves the box that a network was trained in
    (beyond it a network is wild), or whatever the transport itself says of it.
    """
    if hasattr(transport, "refuse_foreign"):
        transport.refuse_foreign(mesh)
    if not hasattr(transport, "box_min") or not hasattr(transport, "box_side"):
        return
    corner = transport.box_min
    low = np.asarray(corner.cpu() if hasattr(corner, "cpu") else corner, np.float64)
    side = float(transport.box_side)
    beyond = np.maximum(low - mesh.positions, mesh.positions - low - side).max(axis=1)
    outside = np.flatnonzero(beyond > OUTSIDE * side)
    if len(outside):
        first = int(outside[0])
        raise QueryError(
            f"mesh: {len(outside)} of {len(mesh.positions)} vertices lie outside the box that the model was trained "
            f"in; the first is number {first}, {beyond[first]:.3g} away; bake the mesh of the model's own scene"
        )


def prepared(transport: Any, precision: str, device: str) -> Any:
    """The transport in its fast form, if it has one."""
    if hasattr(transport, "prepared"):
        return transport.prepared(precision=precision, device=device)
    if precision != "float32" or device != "cpu":
        raise QueryError(
            f"{type(transport).__name__} can only be baked with precision float32 on the cpu, "
            f"asked for {precision} on {device}: those are for networks"
        )
    return transport


@contextmanager
def limited_threads(transport: Any, workers: int) -> Iterator[None]:
    """Random walks take `workers` threads, as many as there are at most; torch one intra-op thread a worker, if it is
    loaded at all: more of them get in one another's way.
    """
    with ExitStack() as before:
        if way_in(transport) == "coefficients":
            import numba

            settings: Any = numba.config
            before.callback(numba.set_num_threads, numba.get_num_threads())
            numba.set_num_threads(max(1, min(workers, settings.NUMBA_NUM_THREADS)))
        if (torch := sys.modules.get("torch")) is not None:
            before.callback(torch.set_num_threads, torch.get_num_threads())
            torch.set_num_threads(1)
        yield
