"""Settings and the result of one pass of an adaptive bake, and the baking of a block."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bakers.adaptive.calibration import Correction, Tally
from bakers.adaptive.records import Lattices, RefinedBlock, RefinementSettings
from bakers.adaptive.refinement import refine
from prt_bake.baking.adaptive.adaptive_job import AdaptiveJob
from prt_bake.baking.adaptive.parent_vertices import Interpolation
from prt_bake.baking.adaptive.pilot_cost import PilotCost

Index = NDArray[np.int64]

LATTICES: tuple[Lattices, ...] = ("own", "shared", "learned")
VIEW_OVER_LIGHT = 2.0
"""Usual tolerance of interpolation between views, over that of the integration over directions."""
VALIDATION_NOISE = 0.7
"""Noise of each of the two lattices of a validation sample, over the requested error."""


@dataclass(frozen=True)
class PassSettings:
    """Tolerances of a pass, and what a pilot predicts of it."""

    refinement: RefinementSettings
    correction: Correction
    error: float
    """Predicted error: the larger of the object's relative RMSE and its 95th percentile over vertices."""
    seconds: float
    """Predicted time of one worker for one vertex."""
    pilot_cost: PilotCost
    evaluations_per_vertex: float
    """Without validation samples."""
    evaluations_per_validation_bin: float = 0.0
    interpolation: Interpolation | None = None
    """Interpolation of most vertices from others, if it pays."""
    rebake: NDArray[np.bool_] | None = None
    """Vertices [V] to bake; the others keep the values of the pass before. None: all vertices."""

    @property
    def active_interpolation(self) -> Interpolation | None:
        """The interpolation in this pass; vertices that are baked again are not interpolated."""
        return self.interpolation if self.rebake is None else None


def uncalibrated(refinement: RefinementSettings, error: float) -> PassSettings:
    """Settings for about that error, without a pilot."""
    refinement = replace(
        refinement.with_full_levels(error, VIEW_OVER_LIGHT * error),
        light_tolerance=error,
        view_tolerance=VIEW_OVER_LIGHT * error,
        validation_noise=VALIDATION_NOISE * error,
        initial_sizes=refinement.initial_sizes_for(error),
    )
    return PassSettings(refinement, Correction(), error, 0.0, PilotCost(), 0.0)


def refined_block(job: AdaptiveJob, refinement: RefinementSettings, vertices: Index) -> tuple[RefinedBlock, int]:
    """Bakes a block; also the number of its bins that were clamped to the horizon."""
    outgoing, clamped = job.views(vertices)
    return refine(job.transport, refinement, vertices, job.mesh.positions[vertices], outgoing), clamped


@dataclass(frozen=True)
class Pass:
    """The result of a pass over all vertices, or those that there was time for, and its seconds if it is complete."""

    tally: Tally
    correction: Correction
    total: float
    percentile_95: float
    complete: bool
    seconds: float = 0.0

    @staticmethod
    def of(tally: Tally, before: Correction, *, complete: bool, seconds: float = 0.0) -> "Pass":
        """The errors of the vertices in the tally, corrected by their samples and the prior `before`."""
        correction = tally.correction(before)
        return Pass(tally, correction, *tally.relative(correction), complete, seconds)

    @property
    def worst(self) -> float:
        """The error that is compared with the requested one."""
        return worst_of(self.total, self.percentile_95)


def worst_of(total: float, percentile_95: float) -> float:
    """The error figure that is compared with the requested error."""
    return max(total, percentile_95)
