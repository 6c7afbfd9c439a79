"""The layout of an asset file, HDF5 (https://support.hdfgroup.org/documentation/hdf5/latest/_f_m_t3.html).

format_version 1.0, little-endian, with the filters gzip and shuffle only:

    /             attributes format, format_version, generator, created, up, handedness, unit, colour, complete,
                  left_out (JSON); optional: network_error (`total_error.py`)
    /mesh         positions (add the attribute origin), normals, tangents, faces, uv, source_vertex; optional attribute
                  flat_shaded
    /basis        attributes kind, degree, order, sign, normalisation; check_directions, check_values
    /bins         directions; attributes rings, sectors, interpolation, solid_angle
    /transfer     coefficients [V,B,K,C], valid [V], standard_error [V,B]; attributes quantity, formula, folded_in;
                  the error covariance (`error_covariance.py`): error_covariance, error_channels, error_apart, error_row
    /selftest     light, vertex, outgoing, radiance; optional: sun, lobes
    /lobes        optional, format_version 1.1 (`formats.asset.lobes`)
    /provenance   json (one string), error_vs_time [rows,3]

The axes B and C may have length 1 and are then broadcast: the view does not matter, or the channels are equal. Vertices
with valid = 0 were not baked: their chunks are not written and read as 0. A compact asset has /transfer_compact instead
of /transfer (`formats.asset.compact_file`).
"""

from collections.abc import Iterator
from typing import Any

import h5py
import numpy as np

from formats.asset import compact_layout, error_covariance, selftest
from formats.asset.head import BASIS, FORMAT, FORMULAS
from formats.asset.provenance import provenance_faults, pruned_faults
from formats.asset.total_error import network_error_faults
from formats.hdf5_file import attribute, found
from formats.hdf5_strings import read_string

_ATTRIBUTES = {
    "": ("up", "handedness", "unit", "complete", "left_out"),
    "basis": ("kind", "degree", "order", "sign", "normalisation"),
    "bins": ("rings", "sectors"),
}
# Kinds of NumPy types, then lengths: letters are the axes of the asset, "|1" allows a broadcast axis.
_DATASETS: dict[str, tuple[str, tuple[str, ...]]] = {
    "mesh/positions": ("f", ("V", "3")),
    "mesh/normals": ("f", ("V", "3")),
    "mesh/tangents": ("f", ("V", "3")),
    "mesh/faces": ("iu", ("F", "3")),
    "basis/check_directions": ("f", ("2", "3")),
    "basis/check_values": ("f", ("2", "K")),
    "bins/directions": ("f", ("B", "3")),
    "provenance/json": ("O", ()),
    "provenance/error_vs_time": ("f", ("rows", "3")),
}
_PLAIN_DATASETS: dict[str, tuple[str, tuple[str, ...]]] = {
    "transfer/coefficients": ("f", ("V", "B|1", "K|1", "3|1")),
    "transfer/standard_error": ("f", ("V", "B|1")),
    "transfer/valid": ("iub", ("V",)),
}
_OPTIONAL_DATASETS: dict[str, tuple[str, tuple[str, ...]]] = {
    "mesh/uv": ("f", ("V", "2")),
    "mesh/source_vertex": ("iu", ("n",)),
    **selftest.DATASETS,
    **selftest.OF_LOBES,
}


def layout_faults(file: Any) -> Iterator[str]:
    """Yield a sentence for every attribute or dataset of an open asset that is missing or invalid."""
    form, version = (
        attribute(file, name) if name in file.attrs else "missing" for name in ("format", "format_version")
    )
    if not _is(form, FORMAT):
        yield f"is not an asset of prtbake: expected the attribute format = '{FORMAT}', found {found(form)}"
        return
    version = found(version) if isinstance(version, np.ndarray) else str(version)
    if version.split(".")[0] != "1":
        yield f"has format_version {version}; this program reads 1.x; use a newer version of prtbake"
        return
    faults = list(_missing_attributes(file)) or list(_attribute_faults(file))
    yield from faults or _dataset_faults(file)


def transfer_group(file: Any) -> str:
    """Return the group of the coefficients of an open asset, "transfer_compact" or "transfer"."""
    return compact_layout.GROUP if compact_layout.GROUP in file else "transfer"


def _missing_attributes(file: Any) -> Iterator[str]:
    compact = transfer_group(file) == compact_layout.GROUP
    transfer = compact_layout.ATTRIBUTES if compact else {"transfer": ("quantity", "folded_in")}
    for group, names in {**_ATTRIBUTES, **transfer}.items():
        if group and not isinstance(file.get(group), h5py.Group):
            yield f"/{group} is missing"
            continue
        for name in names:
            if name not in (file[group] if group else file).attrs:
                yield f"/{group}: the attribute {name} is missing"


def _attribute_faults(file: Any) -> Iterator[str]:
    for name, allowed in {"up": ("y", "z"), "handedness": ("right",), "complete": (0, 1)}.items():
        value = attribute(file, name)
        if not any(_is(value, choice) for choice in allowed):
            yield f"the attribute {name} is {found(value)}; expected {' or '.join(map(repr, allowed))}"
    if "flat_shaded" in file["mesh"].attrs:
        value = attribute(file["mesh"], "flat_shaded")
        if not any(_is(value, choice) for choice in (0, 1)):
            yield f"/mesh: the attribute flat_shaded is {found(value)}; expected 0 or 1"
    for name, expected in BASIS.items():
        if not _is(value := attribute(file["basis"], name), expected):
            yield f"/basis: the attribute {name} is {found(value)}; expected {expected!r}; bake it again"
    for group, name in (("basis", "degree"), ("bins", "rings"), ("bins", "sectors")):
        value = np.asarray(attribute(file[group], name))
        least = 0 if name == "degree" else 1
        if value.shape != () or value.dtype.kind not in "iu" or not least <= value <= 10**5:
            yield f"/{group}: the attribute {name} is {found(value[()])}; expected an integer from {least} on"
    group = transfer_group(file)
    if not any(_is(attribute(file[group], "quantity"), quantity) for quantity in FORMULAS):
        yield f"/{group}: quantity is {found(attribute(file[group], 'quantity'))}; expected {' or '.join(FORMULAS)}"
    for path, name in (("/", "unit"), (f"/{group}", "folded_in")):
        if not isinstance(value := attribute(file[path], name), str):
            yield f"{path}: the attribute {name} is {found(value)}; expected text"
    yield from network_error_faults(file)
    yield from pruned_faults(attribute(file, "left_out"))


def _is(value: Any, expected: str | int) -> bool:
    """Whether an attribute has the value; arrays have not."""
    return not isinstance(value, np.ndarray) and bool(value == expected)


def _dataset_faults(file: Any) -> Iterator[str]:
    lengths = {
        "K": (int(attribute(file["basis"], "degree")) + 1) ** 2,
        "rings": int(attribute(file["bins"], "rings")),
        "sectors": int(attribute(file["bins"], "sectors")),
    }
    lengths["B"] = lengths["rings"] * lengths["sectors"]
    compact = transfer_group(file) == compact_layout.GROUP
    transfer = compact_layout.datasets(file[compact_layout.GROUP]) if compact else _PLAIN_DATASETS
    covariance = {f"{transfer_group(file)}/{name}": axes for name, axes in error_covariance.DATASETS.items()}
    required = {*_DATASETS, *transfer}
    required |= set(selftest.DATASETS) if len(file.get(selftest.GROUP, ())) else set()
    if any(name in file for name in covariance):
        required |= {name for name in covariance if not name.endswith("error_row")}
    for name, (kinds, axes) in {**_DATASETS, **transfer, **covariance, **_OPTIONAL_DATASETS}.items():
        dataset = file.get(name)
        if not isinstance(dataset, h5py.Dataset):
            if name in required:
                yield f"/{name} is missing"
            continue
        shape = dataset.shape
        if dataset.dtype.kind not in kinds:
            yield f"/{name} has type {dataset.dtype}; expected kind {' or '.join(kinds)}"
        if len(shape) != len(axes) or not all(_fits(axis, n, lengths) for axis, n in zip(axes, shape, strict=True)):
            expected = ", ".join(_describe_axis(axis, lengths) for axis in axes)
            yield f"/{name} has shape {list(shape or ())}; expected [{expected}]"
    text = file.get("provenance/json")
    if isinstance(text, h5py.Dataset) and text.shape == ():
        yield from provenance_faults(read_string(text))


def _fits(axis: str, length: int, lengths: dict[str, int]) -> bool:
    """Whether an axis may have this length; the first length of a letter fixes that letter."""
    choices = axis.split("|")
    if not choices[0].isdigit():
        lengths.setdefault(choices[0], length)
    return length in {int(choice) if choice.isdigit() else lengths[choice] for choice in choices}


def _describe_axis(axis: str, lengths: dict[str, int]) -> str:
    return " or ".join(
        choice if choice.isdigit() else f"{choice} = {lengths.get(choice, 'any')}" for choice in axis.split("|")
    )
