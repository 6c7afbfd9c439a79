"""Description and faults of a file of training samples."""

from pathlib import Path
from typing import Any

import numpy as np

from formats.samples import check_samples, read_samples


def describe(path: Path) -> dict[str, Any]:
    """Return the counts, the relative noise and the settings of a file of samples."""
    samples = read_samples(path)
    mean, error = (np.square(values, dtype=np.float64).sum() for values in (samples.mean, samples.standard_error))
    return {
        "queries": len(samples.keys),
        "directions": samples.head.directions,
        "paths per query": samples.head.walks,
        "relative noise": float(np.sqrt(error / max(mean, 1e-300))),
        "complete": samples.complete,
        "scene": samples.head.scene,
        "scene hash": samples.head.scene_hash,
        "unit": samples.head.unit,
        "seed": samples.head.seed,
        **{f"settings: {name}": value for name, value in samples.head.settings.items()},
    }


def find_faults(path: Path) -> list[str]:
    """Return the faults of a file of samples, as `formats.samples.check_samples`."""
    return check_samples(path)
