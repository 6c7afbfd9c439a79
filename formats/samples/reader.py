"""Sample files: queries of a scene's transport function, with path-traced estimates of its values.

HDF5 (https://support.hdfgroup.org/documentation/hdf5/latest/_f_m_t3.html) with checksums. Attributes of the file:
format "prtbake samples", format_version, generator, created, complete (0: sampling was stopped early), seed, walks
(per query), and source (JSON: scene, scene_hash, unit, settings). Datasets:

    queries/keys        [N] u8      identifies a query across files
    queries/positions   [N,3] f8    on the surface, in scene units
    queries/outgoing    [N,3] f4    unit vectors to the eye
    queries/incident    [N,D,3] f4  unit vectors to the light
    estimates/mean              [N,D,3] f4  Ŝ [1/sr]; the D directions of a query share its walks
    estimates/standard_error    [N,D,3] f4  one sigma of the mean
"""

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from formats.errors import PrtbakeError, SamplesError
from formats.hdf5_file import HDF5_ERRORS, describe_damage, first_fault, open_hdf5

FORMAT = "prtbake samples"
FORMAT_VERSION = "1.0"
DATASETS: dict[str, tuple[str, tuple[str, ...]]] = {
    "queries/keys": ("<u8", ("N",)),
    "queries/positions": ("<f8", ("N", "3")),
    "queries/outgoing": ("<f4", ("N", "3")),
    "queries/incident": ("<f4", ("N", "D", "3")),
    "estimates/mean": ("<f4", ("N", "D", "3")),
    "estimates/standard_error": ("<f4", ("N", "D", "3")),
}
_COUNTS = ("complete", "seed", "walks")
_SOURCE = ("scene", "scene_hash", "unit", "settings")
_UNIT_TOLERANCE = 1e-4


@dataclass(frozen=True)
class SamplesHead:
    """The common properties of all samples in a file.

    Attributes:
        scene, scene_hash: name and content hash of the sampled scene.
        unit: unit of length of the scene.
        seed: seed of all random numbers.
        walks: walks per query.
        directions: D, directions of incidence per query.
        settings: everything else that the estimates depend on, JSON values.
    """

    scene: str
    scene_hash: str
    unit: str
    seed: int
    walks: int
    directions: int
    settings: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Samples:
    """N queries of D directions each, and their estimates; the arrays are those of the file."""

    head: SamplesHead
    keys: NDArray[np.uint64]
    positions: NDArray[np.float64]
    outgoing: NDArray[np.float32]
    incident: NDArray[np.float32]
    mean: NDArray[np.float32]
    standard_error: NDArray[np.float32]
    complete: bool


def read_samples(path: str | os.PathLike[str]) -> Samples:
    """Read and check all samples of a file.

    Raises:
        SamplesError: the file is not HDF5, truncated, damaged, or of another kind or version; datasets are missing or
            have the wrong shape or type; values are not finite; directions are not of unit length.
        StorageError: the file is missing.
    """
    with _opened(path) as file:
        try:
            faults = list(_layout_faults(file))
            samples = None if faults else _read(file)
        except HDF5_ERRORS as cause:
            raise SamplesError(f"{path}: {describe_damage(cause)}; copy or sample it again") from cause
    if samples is not None:
        faults = list(_value_faults(samples))
    if samples is None or faults:
        raise SamplesError(f"{path}: {first_fault(faults, 'copy or sample it again')}")
    return samples


def check_samples(path: str | os.PathLike[str]) -> list[str]:
    """Return every fault of a sample file, a sentence each; an empty list means a valid file.

    Raises:
        StorageError: the file is missing.
    """
    try:
        file = _opened(path)
    except SamplesError as fault:
        return [str(fault)]
    with file:
        try:
            faults = list(_layout_faults(file))
            faults = faults or list(_value_faults(_read(file)))
        except HDF5_ERRORS as cause:
            faults = [f"{describe_damage(cause)}; copy or sample it again"]
    return [f"{path}: {fault}" for fault in faults]


def is_samples(path: str | os.PathLike[str]) -> bool:
    """Whether a file has the format attribute of sample files."""
    try:
        with _opened(path) as file:
            return _text(file, "format") == FORMAT
    except (*HDF5_ERRORS, PrtbakeError):
        return False


def _opened(path: str | os.PathLike[str]) -> Any:
    return open_hdf5(path, SamplesError, "is not a sample file", "sample it")


def _layout_faults(file: Any) -> Iterator[str]:
    """Yield a sentence for every attribute or dataset that is missing or invalid."""
    if (found := _text(file, "format")) != FORMAT:
        yield f"is not a sample file: expected the attribute format = '{FORMAT}', found '{found}'"
        return
    version = _text(file, "format_version")
    if version.split(".")[0] != "1":
        yield f"has format_version {version}; this program reads 1.x; use a newer version of prtbake"
        return
    for name in _COUNTS:
        value = np.asarray(file.attrs.get(name, "missing"))
        if value.shape != () or value.dtype.kind not in "iu":
            yield f"the attribute {name} is {value}; expected an integer"
    source = _object(_text(file, "source"))
    for name in _SOURCE:
        if not isinstance(source.get(name), dict if name == "settings" else str):
            yield f"the attribute source has no valid {name}"
    lengths: dict[str, int] = {}
    for name, (kind, axes) in DATASETS.items():
        dataset = file.get(name)
        if not isinstance(dataset, h5py.Dataset):
            yield f"/{name} is missing"
            continue
        if dataset.dtype != np.dtype(kind):
            yield f"/{name} has type {dataset.dtype}; expected {np.dtype(kind)}"
        shape = list(dataset.shape or ())
        expected = [int(axis) if axis.isdigit() else lengths.get(axis, n) for axis, n in zip(axes, shape, strict=False)]
        if len(shape) != len(axes) or shape != expected:
            wanted = ", ".join(axis if axis.isdigit() else f"{axis} = {lengths.get(axis, 'any')}" for axis in axes)
            yield f"/{name} has shape {shape}; expected [{wanted}]"
            continue
        lengths.update({axis: n for axis, n in zip(axes, shape, strict=True) if not axis.isdigit()})
    if lengths.get("N") == 0 or lengths.get("D") == 0:
        yield "has no queries"


def _read(file: Any) -> Samples:
    arrays = {name.partition("/")[2]: file[name][...] for name in DATASETS}
    source = _object(_text(file, "source"))
    head = SamplesHead(
        **{name: source[name] for name in _SOURCE},
        seed=int(file.attrs["seed"]),
        walks=int(file.attrs["walks"]),
        directions=arrays["incident"].shape[1],
    )
    return Samples(head, **arrays, complete=bool(file.attrs["complete"]))


def _value_faults(samples: Samples) -> Iterator[str]:
    for name in ("positions", "mean", "standard_error"):
        values = getattr(samples, name).reshape(len(samples.keys), -1)
        yield from _row_faults(name, ~np.isfinite(values).all(axis=1), "not finite")
    for name in ("outgoing", "incident"):
        length = np.linalg.norm(getattr(samples, name).astype(np.float64), axis=-1).reshape(len(samples.keys), -1)
        yield from _row_faults(name, ~(np.abs(length - 1.0) < _UNIT_TOLERANCE).all(axis=1), "not of length 1")
    negative = np.asarray((samples.standard_error < 0).any(axis=(1, 2)))
    yield from _row_faults("standard_error", negative, "negative")


def _row_faults(name: str, wrong: NDArray[np.bool_], problem: str) -> Iterator[str]:
    if wrong.any():
        yield f"{name}: {wrong.sum()} of {len(wrong)} queries are {problem}, the first is query {wrong.argmax()}"


def _text(file: Any, name: str) -> str:
    """Return a text attribute. It has a fixed length, because variable-length text of HDF5 has no checksum."""
    found = file.attrs.get(name, "missing")
    return found.decode("utf-8", "replace") if isinstance(found, bytes) else str(found)


def _object(text: str) -> dict[str, Any]:
    try:
        found = json.loads(text)
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}
