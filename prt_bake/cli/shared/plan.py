"""The plan of a bake, and what its lobes gain, as text for a terminal."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

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


def lobes_sentence(entry: dict[str, Any]) -> str:
    """A sentence for an asset's provenance entry "lobes"."""
    gains = ""
    if "beyond_harmonics" in entry:
        gains = f"; {entry['beyond_harmonics']:.1%} of the transport lies beyond the harmonics"
        gains += f", {entry['left_by_lobes'][-1]:.1%} beyond the lobes too" if entry["lobes_in_a_view"] else ""
    if not entry["lobes_in_a_view"]:
        return f"lobes: none, {entry['reason']}{gains}"
    return f"lobes: {entry['lobes_in_a_view']} in a view{gains}"
