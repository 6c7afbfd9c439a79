"""The sentence on what lobes gain."""

from typing import Any


def lobes_sentence(entry: dict[str, Any]) -> str:
    """A sentence for an asset's provenance entry "lobes"."""
    gains = ""
    if "beyond_harmonics" in entry:
        gains = f"; {entry['beyond_harmonics']:.1%} of the transport lies beyond the harmonics"
        gains += f", {entry['left_by_lobes'][-1]:.1%} beyond the lobes too" if entry["lobes_in_a_view"] else ""
    if not entry["lobes_in_a_view"]:
        return f"lobes: none, {entry['reason']}{gains}"
    return f"lobes: {entry['lobes_in_a_view']} in a view{gains}"
