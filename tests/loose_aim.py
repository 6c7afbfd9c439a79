"""A pilot that is too sure of itself: what follows it takes a second pass."""

from dataclasses import replace

from bakers.crew import Crew
from bakers.refined import Refinement
from prt_bake.bake_first_look import Site
from prt_bake.bake_refined import Aim, aimed


def loosely_aimed(site: Site, refinement: Refinement, error: float, crew: Crew) -> Aim:
    """`aimed`, its tolerances twice as wide."""
    aim = aimed(site, refinement, error, crew)
    wide = replace(aim.refinement, light=2.0 * aim.refinement.light, view=2.0 * aim.refinement.view)
    return replace(aim, refinement=wide)
