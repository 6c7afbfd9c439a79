"""A bake with everything resolved: where, in which bins and basis, how the light is sampled."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bakers.baker import Sampling, Task
from bakers.path_traced import Walks
from formats.mesh import Mesh
from prt_bake.baking.job.pruning_record import Needs
from prt_bake.baking.job.sampling import Resolved, resolve_sampling
from prt_bake.baking.job.views import views_of
from prt_bake.mathematics.view_frames import frames_of


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
    needs: Needs | None = None

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
    needs: Needs | None = None,
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
