"""How many threads render and learn, and what a processor with many cores traces."""

import pytest

from prt_bake.trainer import cores, training_data
from prt_bake.trainer.training_data import stream_for


@pytest.mark.parametrize(("share", "learn"), [(0.25, (1, 1, 2, 4)), (0.5, (1, 2, 4, 8)), (0.0, (1, 1, 1, 1))])
def test_renderer_and_learner_divide_the_cores_and_share_one(
    monkeypatch: pytest.MonkeyPatch, share: float, learn: tuple[int, ...]
) -> None:
    monkeypatch.setattr(cores, "_numba_limit", lambda threads: threads)
    for count, learner in zip((2, 4, 8, 16), learn, strict=True):
        monkeypatch.setattr(cores, "available_cores", lambda count=count: count)
        assert cores.concurrent_threads(share, "cpu") == (count - learner + 1, learner)
        assert cores.concurrent_threads(share, "cuda") == (count, 1)
    monkeypatch.setattr(cores, "available_cores", lambda: 1)
    assert cores.concurrent_threads(share, "cpu") == (1, 1)


def test_many_cores_trace_more_paths_except_in_synchronous_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    for count, paths in ((2, 32), (8, 32), (16, 64), (64, 256)):
        monkeypatch.setattr(training_data, "available_cores", lambda count=count: count)
        assert stream_for("cpu", synchronous=False).exits == paths
        assert stream_for("cpu", synchronous=True).exits == 32
        assert {stream_for("cpu", synchronous).rays for synchronous in (False, True)} == {"exits"}
