"""The result of one pass of an adaptive bake."""

from dataclasses import dataclass

from bakers.adaptive.calibration import Correction, Tally
from prt_bake.baking.adaptive.pass_settings import worst_of


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
