"""The plan of a bake as text for a terminal."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

from prt_bake.cli.shared.lobes import lobes_sentence
from prt_bake.cli.shared.progress import in_words

if TYPE_CHECKING:
    from bakers.plan import BakePlan


def plan_lines(plan: "BakePlan") -> Iterator[str]:
    """Yield the size and time of the bake, then each pruning: its reason, saving and the cost of testing for it."""
    bins = plan.vertices * plan.bins
    yield f"{plan.vertices:,} vertices × {plan.bins:,} view bins, {plan.coefficients} SH coefficients"
    yield f"{plan.evaluations:,} evaluations, {plan.evaluations / max(1, bins):.1f} per bin"
    yield f"{plan.raw_bytes / 1e6:,.1f} MB of coefficients before compression"
    if plan.effort:
        expected = "" if plan.error is None else f", expected error {plan.error:.2%}"
        yield f"bakes {plan.effort}" + ("" if plan.effort.startswith("to ") else expected)
    if plan.seconds is not None:
        between = "" if plan.seconds_between is None else f", {' to '.join(map(in_words, plan.seconds_between))}"
        yield f"about {in_words(plan.seconds)}{between}"
    if plan.lobes:
        cost = (
            f"; {plan.lobes['bytes'] / 1e6:,.1f} MB, {in_words(plan.lobes['seconds'])}" if plan.lobes["bytes"] else ""
        )
        yield lobes_sentence(plan.lobes) + cost
    for title, items in (("pruned", plan.left_out), ("kept", plan.kept)):
        for item in items:
            saving = f"; {item.saving}" if item.saving else ""
            yield f"{title}: {item.item}: {item.reason}{saving}; cost: {item.cost}"
