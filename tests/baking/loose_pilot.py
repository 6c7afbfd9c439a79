"""A pilot that is too sure of itself: what follows it takes a second pass."""

from dataclasses import replace

from bakers.adaptive.records import Refinement
from prt_bake.baking.adaptive.tolerances import Aim, Pilot, aimed


def loosely_aimed(pilot: Pilot, refinement: Refinement, error: float) -> Aim:
    """`aimed`, its tolerances twice as wide."""
    aim = aimed(pilot, refinement, error)
    wide = replace(aim.refinement, light=2.0 * aim.refinement.light, view=2.0 * aim.refinement.view)
    return replace(aim, refinement=wide)
