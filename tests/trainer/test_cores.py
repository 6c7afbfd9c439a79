"""How many threads render and learn, and what a processor with many cores traces."""

import pytest

from prt_bake.trainer import cores, training_data
from prt_bake.trainer.training_data import stream_for


def test_renderer_and_learner_divide_the_cores_and_share_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cores, "_numba_limit", lambda threads: threads)
    for count, learner in ((2, 1), (4, 1), (8, 2), (16, 4)):
        monkeypatch.setattr(cores, "available_cores", lambda count=count: count)
        assert cores.concurrent_threads("cpu") == (count - learner + 1, learner)
        assert cores.concurrent_threads("cuda") == (count, 1)
    monkeypatch.setattr(cores, "available_cores", lambda: 1)
    assert cores.concurrent_threads("cpu") == (1, 1)


def test_many_cores_trace_more_paths_except_in_synchronous_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    for count, paths in ((2, 32), (8, 32), (16, 64), (64, 256)):
        monkeypatch.setattr(training_data, "available_cores", lambda count=count: count)
        assert stream_for("cpu", synchronous=False).exits == paths
        assert stream_for("cpu", synchronous=True).exits == 32
        assert {stream_for("cpu", synchronous).rays for synchronous in (False, True)} == {"exits"}
