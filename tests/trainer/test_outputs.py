"""A training finds out at once whether it can write its outputs."""

from pathlib import Path

import pytest

from formats.errors import StorageError
from prt_bake.network.file_names import state_path
from tests.trainer.small_training import make_scene, train_small


def test_an_output_that_cannot_be_written_is_refused_before_anything_is_traced(tmp_path: Path) -> None:
    scene = make_scene(tmp_path)

    def refuse_steps(sentence: str) -> None:
        pytest.fail(f"the training began: {sentence}")

    with pytest.raises(StorageError, match="none does not exist"):
        train_small(scene, 10, output=tmp_path / "none" / "m.pt", say=refuse_steps)
    state_path(tmp_path / "m.pt").mkdir()
    with pytest.raises(StorageError, match=r"m\.train\.pt: cannot be written: it is a folder"):
        train_small(scene, 10, output=tmp_path / "m.pt", say=refuse_steps)
