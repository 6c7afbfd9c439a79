"""A pilot with too large tolerances, after which a bake needs a second pass."""

from dataclasses import replace

from bakers.adaptive.records import RefinementSettings
from prt_bake.baking.adaptive.pass_settings import PassSettings
from prt_bake.baking.adaptive.tolerances import settings_for_error
from prt_bake.baking.adaptive.trials import Pilot


def loose_settings(pilot: Pilot, refinement: RefinementSettings, error: float) -> PassSettings:
    """`settings_for_error` with doubled tolerances."""
    settings = settings_for_error(pilot, refinement, error)
    wide = replace(
        settings.refinement,
        light_tolerance=2.0 * settings.refinement.light_tolerance,
        view_tolerance=2.0 * settings.refinement.view_tolerance,
    )
    return replace(settings, refinement=wide)
