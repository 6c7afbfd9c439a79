"""A short form of `tests.bench.faults`: damaged files of every kind are read or refused, and nothing else."""

import contextlib
import random
import warnings
from pathlib import Path

import pytest

from formats.errors import PrtbakeError
from tests.bench.faults import mutated
from tests.bench.small_files import KINDS


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_files_are_read_or_refused(kind: str, tmp_path: Path) -> None:
    make, read = KINDS[kind]
    valid = make(tmp_path)
    contents = [path.read_bytes() for path in valid]
    read(valid[0])
    draw = random.Random(kind)
    path = tmp_path / f"damaged{''.join(valid[0].suffixes)}"
    for _ in range(25):
        path.write_bytes(mutated(draw.choice(contents), draw.choice(contents), draw))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with contextlib.suppress(PrtbakeError):
                read(path)
