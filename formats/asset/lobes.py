"""Lobes of an asset: what its transport holds beyond the harmonics, as spherical Gaussians.

The group /lobes, format_version 1.1. The nodes N are view bins of their own, coarser than /bins, interpolated alike:

    /lobes    attributes rings, sectors, formula, interpolation
      axes        [V,N,J,3]  in object space, of length 1 up to rounding
      sharpness   [V,N,J]    greater than 0
      powers      [V,N,J,3]  integrals over the sphere in RGB, may be negative; 0 without a lobe

The harmonics stand alone: a program that ignores the group shows them without the lobes.
"""

import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from formats.asset.selftest import GROUP as SELFTEST
from formats.asset.selftest import write_selftest
from formats.atomic import replacing
from formats.hdf5_file import attribute, found
from formats.hdf5_sink import Sink
from formats.interrupts import deferred
from formats.summary import summary

GROUP = "lobes"
FORMAT_VERSION, VERSION_WITH_LOBES = "1.0", "1.1"
LOBE_BYTES = 14
"""Of a lobe in a file, before compression, if float16 represents its powers."""
LEAST_SHARPNESS, MOST_SHARPNESS = 1e-3, 300.0
"""The widest lobes, and the narrowest ones, which fall to 61 % at 3.3° from the axis."""
FORMULA = (
    "S(w) = sum over j of powers_j * G(w; axes_j, sharpness_j), G = exp(k (w.m - 1)) * k / (2 pi (1 - exp(-2 k))); "
    "added to the transport without its harmonics up to the degree of /basis"
)
INTERPOLATION = (
    "weights as in /bins, for these rings and sectors; powers: linear; axes and the logarithm of the sharpness: "
    "linear, each node also weighted by the sum of its absolute powers; axes are normalised afterwards"
)
_DATASETS = {"axes": (3,), "sharpness": (), "powers": (3,)}
_UNIT_TOLERANCE = 0.3
"""Compact assets round axes; they are normalised after the interpolation."""
_MOST_IN_A_VIEW = 16
_LEAST_PEAK, _MOST_PEAK = 1e-2, 3e4
"""The largest power, if float16 stores powers."""
_CHUNK_BYTES = 2**20


@dataclass(frozen=True, eq=False)
class Lobes:
    """J lobes at each of N = rings · sectors nodes of V vertices.

    Attributes:
        axes: float32 [V,N,J,3], in object space, of length 1 up to rounding.
        sharpness: float32 [V,N,J].
        powers: float32 [V,N,J,3], integrals of Ŝ over the sphere; 0 at vertices that were not baked.
    """

    rings: int
    sectors: int
    axes: NDArray[np.float32]
    sharpness: NDArray[np.float32]
    powers: NDArray[np.float32]

    @property
    def count(self) -> int:
        """Return J."""
        return int(self.sharpness.shape[2])

    __repr__ = summary


def add_lobes_to_file(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    lobes: Lobes | None,
    provenance: Mapping[str, Any],
    selftest: Mapping[str, NDArray[Any]],
) -> None:
    """Copy an asset file with these lobes, None for none, in place of its own; all else stays as it is.

    Args:
        source, target: may be the same file.
        lobes: of the asset's vertices.
        provenance: entries added to the asset's provenance.
        selftest: all datasets of the new self-test.

    Raises StorageError if the target cannot be written.
    """
    with replacing(target) as part, deferred():
        sink = Sink(part)
        with h5py.File(source) as old, h5py.File(sink, "w") as file:
            # Objects are copied one by one: HDF5 would keep the space of a deleted group.
            for name in old:
                if name not in (GROUP, SELFTEST):
                    old.copy(name, file)
            file.attrs.update(old.attrs)
            file.attrs["format_version"] = FORMAT_VERSION
            if lobes is not None:
                write_lobes(file, lobes)
            write_selftest(file, selftest)
            entries = json.loads(old["provenance/json"][()]) | dict(provenance)
            del file["provenance/json"]
            file.create_dataset("provenance/json", data=json.dumps(entries, ensure_ascii=False, allow_nan=False))
        if sink.error is not None:
            raise sink.error
        sink.close()


def write_lobes(file: Any, lobes: Lobes) -> None:
    """Write the group into an open asset; powers in float16 if it represents them."""
    file.attrs["format_version"] = VERSION_WITH_LOBES
    group = file.create_group(GROUP)
    group.attrs.update(rings=lobes.rings, sectors=lobes.sectors, formula=FORMULA, interpolation=INTERPOLATION)
    for name, values in _typed(lobes).items():
        kind = values.dtype
        rows = max(1, min(len(values), _CHUNK_BYTES // max(1, values[:1].size * kind.itemsize)))
        chunks = (rows, *values.shape[1:])
        group.create_dataset(name, data=values, chunks=chunks, compression=4, shuffle=True)


def as_stored(lobes: Lobes) -> Lobes:
    """Return the lobes with the numbers that a file stores."""
    stored = {name: values.astype(np.float32) for name, values in _typed(lobes).items()}
    return Lobes(lobes.rings, lobes.sectors, **stored)


def _typed(lobes: Lobes) -> dict[str, NDArray[np.floating]]:
    """Return the datasets in the types of a file: float16, if it represents the powers."""
    wide = not _LEAST_PEAK <= np.abs(lobes.powers).max() <= _MOST_PEAK
    return {
        "axes": lobes.axes.astype("<f2"),
        "sharpness": lobes.sharpness.astype("<f2"),
        "powers": lobes.powers.astype("<f4" if wide else "<f2"),
    }


def read_lobes(file: Any) -> Lobes | None:
    """Read the group of an open asset without faults; None if it has none."""
    if GROUP not in file:
        return None
    group = file[GROUP]
    axes, sharpness, powers = (group[name][...].astype(np.float32) for name in _DATASETS)
    return Lobes(int(attribute(group, "rings")), int(attribute(group, "sectors")), axes, sharpness, powers)


def lobe_faults(file: Any, vertices: int) -> Iterator[str]:
    """Yield a sentence for every fault of the group of an open asset; nothing if it has none."""
    if GROUP not in file:
        return
    group = file[GROUP]
    faults = list(_layout_faults(file, group, vertices))
    yield from faults or _value_faults(group)


def _layout_faults(file: Any, group: Any, vertices: int) -> Iterator[str]:
    nodes, bins = 1, int(attribute(file["bins"], "rings")) * int(attribute(file["bins"], "sectors"))
    for name in ("rings", "sectors"):
        value = np.asarray(attribute(group, name)) if name in group.attrs else np.asarray("missing")
        if value.shape != () or value.dtype.kind not in "iu" or not 1 <= value <= bins:
            yield f"/{GROUP}: the attribute {name} is {found(value[()])}; expected an integer from 1 to {bins}"
            return
        nodes *= int(value)
    if nodes > bins:
        yield f"/{GROUP} has {nodes:,} nodes; expected at most as many as view bins, {bins:,}"
        return
    missing = [name for name in _DATASETS if not isinstance(group.get(name), h5py.Dataset)]
    if missing:
        yield from (f"/{GROUP}/{name} is missing" for name in missing)
        return
    count = group["sharpness"].shape[-1] if group["sharpness"].ndim == 3 else 1
    if not 1 <= count <= _MOST_IN_A_VIEW:
        yield f"/{GROUP} has {count:,} lobes in a view; expected 1 to {_MOST_IN_A_VIEW}"
        return
    for name, last in _DATASETS.items():
        shape, expected = group[name].shape, (vertices, nodes, count, *last)
        if group[name].dtype.kind != "f" or shape != expected:
            yield f"/{GROUP}/{name} is {group[name].dtype} {list(shape)}; expected floats of shape {list(expected)}"


def _value_faults(group: Any) -> Iterator[str]:
    length = np.linalg.norm(group["axes"][...].astype(np.float64), axis=-1)
    sharpness = group["sharpness"][...].astype(np.float64)
    valid = {
        "axes": np.abs(length - 1.0) <= _UNIT_TOLERANCE,
        "sharpness": (sharpness > 0.0) & np.isfinite(sharpness),
        "powers": np.isfinite(group["powers"][...].astype(np.float32)).all(axis=-1),
    }
    expected = {"axes": "of length about 1", "sharpness": "finite and greater than 0", "powers": "finite"}
    for name, each in valid.items():
        rows = each.all(axis=(1, 2))
        if not rows.all():
            yield (
                f"/{GROUP}/{name}: not {expected[name]} at {(~rows).sum()} of {len(rows)} vertices, the first is "
                f"{rows.argmin()}"
            )
