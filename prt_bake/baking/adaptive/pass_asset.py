"""Writes the asset of a pass of an adaptive bake, from its checkpoints."""

from collections import Counter
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.records import FROM_VERTICES, METHODS, RefinedBlock
from bakers.baker import Block
from formats.asset import Asset
from prt_bake.baking.adaptive.adaptive_job import AdaptiveJob
from prt_bake.baking.adaptive.checkpoints import PassCheckpoints
from prt_bake.baking.adaptive.pass_settings import Pass, PassSettings
from prt_bake.baking.job.provenance import outcome
from prt_bake.baking.job.work import Work
from prt_bake.baking.output.pruned_sink import open_pruned_sink


def write_asset(
    work: Work,
    job: AdaptiveJob,
    checkpoints: PassCheckpoints,
    settings: PassSettings,
    done: Pass,
    passes: int,
    rows: list[tuple[float, float, float]],
) -> Asset:
    """Writes the asset of a pass, with standard errors corrected by the validation samples.

    passes: number of passes so far. rows: seconds, evaluations and estimated error after each of them.
    """
    clamped, interpolated, by_directions = 0, 0, Counter[int]()
    with open_pruned_sink(work.out, work.head, work.storage, work.pruning) as sink:
        for first in job.blocks:
            vertices = job.block(first)
            if not done.tally.done[vertices[0]]:
                break
            refined, clamped_here = checkpoints.require(first)
            clamped += clamped_here
            interpolated += int((refined.method == FROM_VERTICES).all(axis=1).sum())
            sizes, counts = np.unique(refined.directions, return_counts=True)
            by_directions.update(dict(zip(sizes.tolist(), counts.tolist(), strict=True)))
            for block in _calibrated(refined, vertices, done):
                sink.write(block)
        invalid, baked = np.flatnonzero(done.tally.invalid).tolist(), int(done.tally.done.sum())
        report = work.report | outcome(work, done.total, done.percentile_95, clamped, invalid, baked)
        report["refinement"] = {
            "passes": passes,
            "bins_by_directions": {str(size): by_directions[size] for size in sorted(by_directions)},
            "bins_interpolated": 1.0 - done.tally.evaluated_bins / max(1, done.tally.bins),
            "vertices_interpolated": interpolated,
            "bins_validated": done.tally.validated_bins,
            "validated_over_stated_variance": dict(zip(METHODS, done.correction.factors.tolist(), strict=True)),
            "bound_factor": done.correction.bound,
            "lattice_gain": {"shared": vars(settings.refinement.noise), "alone": vars(settings.refinement.pool_noise)},
        }
        return sink.finish(report, np.array(rows).reshape(-1, 3), complete=done.complete)


def _calibrated(refined: RefinedBlock, vertices: NDArray[np.int64], done: Pass) -> Iterator[Block]:
    """The block with calibrated standard errors, a part for each run of consecutive vertices."""
    valid = refined.valid
    corrected = done.correction.standard_error(refined.standard_error, refined.method)
    coefficients = np.where(valid[:, None, None, None], refined.coefficients, np.float32(0.0))
    standard_error = np.where(valid[:, None], corrected, 0.0).astype(np.float32)
    for rows in np.split(np.arange(len(vertices)), np.flatnonzero(np.diff(vertices) > 1) + 1):
        yield Block(
            int(vertices[rows[0]]),
            coefficients[rows],
            standard_error[rows],
            valid[rows],
            clamped=0,
            correlated=refined.correlated[rows],
            error_covariance=refined.error_covariance.at_vertices(rows),
            bound=done.correction.bound,
        )
