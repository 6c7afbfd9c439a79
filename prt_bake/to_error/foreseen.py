"""What a bake to an error will take, all included: looks, the pilot, and a pass with its checks."""

from prt_bake.to_error.aim import CHECK_NOISE, Aim, pilot_vertices
from prt_bake.to_error.first_look import Site


def evaluations_of(site: Site, aim: Aim, looked: int, error: float) -> int:
    """Evaluations of a bake whose pilot came to that aim, `looked` before it, if one pass is enough.

    What the pilot has evaluated at its vertices it is remembered for.
    """
    anew = len(site.vertices) - len(pilot_vertices(site))
    checks = sum(int(aim.refinement.checks(site.block(first)).sum()) for first in site.blocks)
    # Noise falls with that power of the directions of a check.
    falling = 0.5 + aim.refinement.pool_noise.slope
    less_noise = CHECK_NOISE * min(error, aim.error) / aim.refinement.checked
    each = aim.evaluations_per_check * less_noise ** (1.0 / falling)
    return looked + aim.spent.evaluations + int(anew * aim.evaluations_per_vertex + checks * each)
