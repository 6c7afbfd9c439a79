"""A bake with the same number of samples at every view bin, all arguments resolved."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bakers.baker import Sampling, Task
from bakers.path_traced import Walks
from formats.mesh import Mesh
from prt_bake.baking.job.pruning_record import Pruning
from prt_bake.baking.job.sampling import Resolved, resolve_sampling
from prt_bake.baking.job.views import views_of
from prt_bake.mathematics.view_frames import mesh_view_frames


@dataclass(frozen=True)
class Job:
    """Transport, mesh, view bins, harmonics, sampling and pruning of a bake."""

    transport: Any
    mesh: Mesh
    rings: int
    sectors: int
    degree: int
    resolved: Resolved
    task: Task
    pruning: Pruning | None = None

    @property
    def vertices(self) -> NDArray[np.int64]:
        """Indices of the vertices that are baked."""
        return np.arange(len(self.mesh.positions)) if self.pruning is None else self.pruning.vertices


def resolve(
    transport: Any,
    mesh: Mesh,
    degree: int,
    rings: int,
    sectors: int,
    directions: str,
    samples: int,
    seed: int,
    pruning: Pruning | None = None,
) -> Job:
    """The job for these arguments; without `pruning` everything is baked.

    Raises QueryError as `resolve_sampling` and `views_of` do.
    """
    outgoing, bins, around = views_of(mesh, rings, sectors), rings * sectors, sectors
    if pruning is not None and pruning.views != "all":
        outgoing, bins, around = pruning.outgoing, len(pruning.local), 1
    resolved = resolve_sampling(transport, degree, bins, around, directions, samples, seed)
    sampling = resolved.sampling
    if pruning is not None and pruning.views == "one" and not isinstance(sampling, Walks):
        sampling = _same_directions_in_all_views(sampling)
    task = Task(transport, mesh.positions, outgoing, bins, around, sampling, mesh_view_frames(mesh))
    return Job(transport, mesh, rings, sectors, degree, resolved, task, pruning)


def _same_directions_in_all_views(sampling: Sampling) -> Sampling:
    """The sampling with equal directions in all bins of a vertex, so that noise cancels in their differences."""

    def of_first_bin(rotation: Callable[[int, int], NDArray[np.int64]]) -> Callable[[int, int], NDArray[np.int64]]:
        return lambda first, last: np.broadcast_to(rotation(first, last)[:, :1], rotation(first, last).shape)

    second = None if sampling.second_rotation is None else of_first_bin(sampling.second_rotation)
    return replace(sampling, rotation=of_first_bin(sampling.rotation), second_rotation=second)
