"""Survey of all views of a few vertices before an adaptive bake: it finds what evaluating few of them would miss."""

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.nested_lattice import NestedLattice
from bakers.adaptive.principal_components import PROBE_STAGES
from bakers.adaptive.view_levels import Level
from bakers.adaptive.view_survey import FULL_LEVELS, ViewSurvey
from bakers.workers import Workers
from prt_bake.baking.adaptive.adaptive_job import AdaptiveJob
from prt_bake.baking.job.lattices import pair_rotations, sample_without_replacement

Array = NDArray[np.float64]

SURVEY_SHARE, MOST_SURVEYED = 10, 32
"""The survey evaluates all bins of one in `SURVEY_SHARE` vertices, and of at most `MOST_SURVEYED`."""


def survey_views(
    job: AdaptiveJob, lattice: NestedLattice, levels: list[Level], floor: float, workers: Workers
) -> tuple[ViewSurvey | None, Array, int]:
    """Evaluates all bins of a few vertices in few directions, if bins will be interpolated. Returns the survey, whose
    errors are relative to coefficients of at least `floor`, or None if no vertex is finite; mean square coefficients
    of the finite vertices [n]; and evaluations.
    """
    if len(levels) <= FULL_LEVELS + 1:
        return None, np.zeros(0), 0
    count = int(np.clip(len(job.vertices) // SURVEY_SHARE, 1, MOST_SURVEYED))
    chosen = np.sort(sample_without_replacement(job.seed + 4, len(job.vertices), count))
    results = list(workers.in_order(lambda place: workers.do(_survey_vertex, (job, lattice), int(place)), chosen))
    coefficients = np.stack([each for each, _energies in results], axis=1)
    evaluations = coefficients[..., 0].size * (lattice.sizes[0] // 2)
    finite = np.isfinite(coefficients).all(axis=(0, 2))
    if not finite.any():
        return None, np.zeros(0), evaluations
    energies = np.stack([each for _coefficients, each in results])[finite].sum(axis=0)
    left = max(float(energies[PROBE_STAGES[0][1] :].sum() / energies.sum()), 0.0) if energies.sum() > 0.0 else 0.0
    survey = ViewSurvey.of(levels, job.local, coefficients[:, finite], floor, left)
    by_vertex = (coefficients[:, finite] ** 2).mean(axis=(0, 2))
    return survey, by_vertex, evaluations


@np.errstate(invalid="ignore", over="ignore")
def _survey_vertex(job: AdaptiveJob, lattice: NestedLattice, place: int) -> tuple[Array, Array]:
    """Coefficients [B,K·3] at all bins of one vertex, from half of the smallest lattice; and the energies of the
    principal components of its values over directions, the largest first.
    """
    few = lattice.sizes[0] // 2
    bins = place * job.bins + np.arange(job.bins)
    rotations = np.broadcast_to(pair_rotations(job.seed, few, 3, bins[:1]), (job.bins, 3, 3))
    values = job.values_at_bins(lattice.directions[:few], rotations, bins).astype(np.float64)
    by_light = values.transpose(1, 0, 2).reshape(few, -1)
    gram = by_light @ by_light.T
    energies = np.full(few, np.nan)
    if np.isfinite(gram).all():
        energies[:] = np.linalg.eigvalsh(gram)[::-1]
    return np.asarray(np.linalg.pinv(lattice.harmonics[:few]) @ values).reshape(job.bins, -1), energies
