"""The layout of /transfer_compact, and its check: attributes, datasets and values that can be decoded."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from formats.hdf5_file import as_float32, attribute, found

GROUP = "transfer_compact"
MAX_DIGITS = 4
ATTRIBUTES = {
    GROUP: ("quantity", "folded_in", "step", "error_asked", "error", "error_percentile_95", "error_worst"),
}
Kinds = dict[str, tuple[str, tuple[str, ...]]]
_ALWAYS: Kinds = {
    "valid": ("iub", ("V",)),
    "standard_error": ("f", ("V", "B|1")),
    "added_error": ("f", ("V",)),
    "channel_basis": ("f", ("J", "K|1", "3|1")),
    "view_component": ("iu", ("P",)),
    "channel_component": ("iu", ("P",)),
}
_FACTORISED: Kinds = {"ring_basis": ("f", ("I", "rings|1")), "sector_basis": ("f", ("M", "sectors|1"))}
_LEARNED: Kinds = {"view_scale": ("f", ("R",))}


def datasets(group: Any) -> Kinds:
    """Return the datasets that this group must have, by path: kinds of types, and axes."""
    learned = "view_scale" in group
    required = {**_ALWAYS, **(_LEARNED if learned else _FACTORISED)}
    required |= dict.fromkeys(digit_names(group, "digits"), ("i", ("P", "V")))
    if learned:
        required |= dict.fromkeys(digit_names(group, "view_digits"), ("i", ("R", "B|1")))
    return {f"{GROUP}/{name}": axes for name, axes in required.items()}


def digit_names(group: Any, stem: str) -> list[str]:
    """Return the names of the digit datasets, the lowest first, up to the highest in the group.

    The attribute of the name `stem` is their number; files of older programs lack it.
    """
    highest = max((d for d in range(MAX_DIGITS) if f"{stem}_{d}" in group), default=0)
    return [f"{stem}_{d}" for d in range(highest + 1)]


def _digit_faults(group: Any, stem: str) -> Iterator[str]:
    names, stated = digit_names(group, stem), attribute(group, stem) if stem in group.attrs else None
    if f"{stem}_{MAX_DIGITS}" in group:
        yield f"/{GROUP}/{stem}_{MAX_DIGITS}: expected at most {MAX_DIGITS} digits"
    if stated is not None and (isinstance(stated, np.ndarray) or stated != len(names)):
        yield (
            f"/{GROUP}: has datasets {names[0]} to {names[-1]}; expected {found(stated)} of them, as its attribute "
            f"{stem} says"
        )


def decoded_views(group: Any) -> int:
    """Return the length of the view axis that a group of valid layout decodes to."""
    if "view_scale" in group:
        return int(group["view_digits_0"].shape[1])
    return int(group["ring_basis"].shape[1]) * int(group["sector_basis"].shape[1])


def value_faults(group: Any) -> Iterator[str]:
    """Yield a sentence for every invalid value in a group of valid layout."""
    for name in ATTRIBUTES[GROUP][2:]:
        value = np.asarray(attribute(group, name))
        if value.shape != () or value.dtype.kind != "f" or not (np.isfinite(value) and value >= 0.0):
            yield f"/{GROUP}: the attribute {name} is {found(value[()])}; expected a number from 0 on"
    for name in ("added_error", "channel_basis", "ring_basis", "sector_basis", "view_scale"):
        if name in group and (wrong := ~np.isfinite(as_float32(group[name][...]))).any():
            yield f"/{GROUP}/{name}: {wrong.sum()} of {wrong.size} values are not finite"
    learned = "view_scale" in group
    views = len(group["view_scale"]) if learned else len(group["ring_basis"]) * len(group["sector_basis"])
    bins = math.prod(int(attribute(group.file["bins"], name)) for name in ("rings", "sectors"))
    decoded = decoded_views(group)
    if decoded not in (1, bins):
        yield f"/{GROUP}: the view basis has {decoded} bins; expected {bins} or 1"
    for name, length in (("view_component", views), ("channel_component", len(group["channel_basis"]))):
        outside = (group[name][...] < 0) | (group[name][...] >= length)
        if outside.any():
            yield f"/{GROUP}/{name}: {outside.sum()} of {outside.size} select basis functions that do not exist"
    pairs = (
        group["view_component"][...].astype(np.int64) * len(group["channel_basis"]) + group["channel_component"][...]
    )
    if len(np.unique(pairs)) < len(pairs):
        duplicates = len(pairs) - len(np.unique(pairs))
        yield f"/{GROUP}: {duplicates} components are the product of the same functions as another"
    descends = np.diff(group["channel_component"][...].astype(np.int64)) < 0
    if descends.any():
        count = f"{descends.sum()} of {len(descends) + 1}"
        yield f"/{GROUP}/channel_component: {count} descend; expected components in ascending order"
    for stem in ("digits", "view_digits") if learned else ("digits",):
        yield from _digit_faults(group, stem)
    for name in digit_names(group, "digits") + (digit_names(group, "view_digits") if learned else []):
        if group[name].dtype.itemsize != 1:
            yield f"/{GROUP}/{name} has type {group[name].dtype}; expected digits in one byte, int8"
