"""The cache of kernels: never stale or mixed up, compiled by one process at a time, and dispensable."""

import math
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import filelock
import numba
import pytest
from numba.core.errors import TypingError

from prt_bake.jit import compilation, notice
from tests import ROOT

PACKAGE = ROOT / "prt_bake"

KERNELS = """
from prt_bake.jit.compilation import compiled
from prt_bake.constants import FACTOR

@compiled()
def times(x):
    return FACTOR * x
"""


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A small tree in place of the packages, with a kernel that takes a constant from another module."""
    (tmp_path / "prt_bake").mkdir()
    for name, text in {"kernels": KERNELS, "constants": "FACTOR = 3\n", "stranger": "\n"}.items():
        (tmp_path / "prt_bake" / f"{name}.py").write_text(text)
    monkeypatch.setattr(compilation, "ROOT", tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "users"))
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    return tmp_path


@pytest.fixture(autouse=True)
def _no_source_was_edited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compilation, "STARTED", math.inf)


def _loaded(root: Path) -> ModuleType:
    """The kernel's module as a new process would load it."""
    for function in (compilation.digest, compilation.sources, compilation.imported):
        function.cache_clear()
    text = KERNELS.replace("from prt_bake.constants import FACTOR", (root / "prt_bake" / "constants.py").read_text())
    module = ModuleType("prt_bake.kernels")
    exec(compile(text, root / "prt_bake" / "kernels.py", "exec"), vars(module))
    return module


def _cached(root: Path) -> list[Path]:
    return sorted(root.rglob("*.nbc"))


def _hits(module: ModuleType) -> int:
    return sum(module.times.stats.cache_hits.values())


def test_a_kernel_is_cached_for_each_signature_and_loaded_again(root: Path) -> None:
    first, second = _loaded(root), _loaded(root)
    assert (first.times(2), first.times(0.5)) == (6, 1.5)
    assert len(_cached(root)) == 2
    assert (second.times(0.5), second.times(2)) == (1.5, 6)
    assert _hits(second) == 2


def test_an_edit_of_any_source_of_a_kernel_replaces_the_cached_one(root: Path) -> None:
    assert _loaded(root).times(2) == 6
    (root / "prt_bake" / "stranger.py").write_text("FACTOR = 7\n")
    assert _hits_after_a_call(root, 6) == 1
    (root / "prt_bake" / "constants.py").write_text("FACTOR = 5\n")
    assert _hits_after_a_call(root, 10) == 0
    assert _hits_after_a_call(root, 10) == 1
    (root / "prt_bake" / "kernels.py").write_text("\n\n" + KERNELS)
    assert _hits_after_a_call(root, 10) == 0
    assert len(_cached(root)) == 1


def _hits_after_a_call(root: Path, expected: int) -> int:
    module = _loaded(root)
    assert module.times(2) == expected
    return _hits(module)


def test_a_process_whose_sources_were_edited_does_not_use_the_cache(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert _loaded(root).times(2) == 6
    constants = root / "prt_bake" / "constants.py"
    monkeypatch.setattr(compilation, "STARTED", constants.stat().st_ctime)
    constants.write_text("FACTOR = 5\n")
    old = _loaded(root)
    assert (old.times(2), old.times(0.5)) == (10, 2.5)
    assert _hits(old) == 0
    assert len(_cached(root)) == 1


def test_a_damaged_file_is_replaced(root: Path) -> None:
    assert _loaded(root).times(2) == 6
    for path in (*_cached(root), *root.rglob("*.nbi")):
        sound = path.read_bytes()
        for damage in (b"", sound[: len(sound) // 2], b"shopping list"):
            path.write_bytes(damage)
            assert _hits_after_a_call(root, 6) == 0
            assert _hits_after_a_call(root, 6) == 1


@pytest.mark.parametrize("users", [True, False], ids=["the user's cache", "nowhere"])
def test_a_read_only_package_falls_back_to_the_users_cache_or_to_none(root: Path, users: bool) -> None:
    """A file in place of the folder represents a read-only folder, since the tests may run as root."""
    (root / "prt_bake" / "__pycache__").write_bytes(b"")
    if not users:
        (root / "users").write_bytes(b"")
    module = _loaded(root)
    assert module.times(2) == 6
    assert [path.is_relative_to(root / "users") for path in _cached(root)] == [True] * users


@pytest.fixture
def said(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What is said about compilation, as if nothing had been compiled yet."""
    sentences: list[str] = []
    monkeypatch.setattr(notice, "say", sentences.append)
    monkeypatch.setattr(notice, "said", False)
    monkeypatch.setattr(notice, "compiled", [])
    return sentences


def test_compilation_is_said_once_and_loading_is_not(root: Path, said: list[str]) -> None:
    first = _loaded(root)
    assert (first.times(2), first.times(0.5)) == (6, 1.5)
    folder = root / "prt_bake" / "__pycache__"
    assert said == [f"compiling kernels, once; this takes about a minute, and they are kept in {folder}"]
    assert [name for name, seconds in notice.compiled if seconds > 0.0] == ["times", "times"]
    notice.said = False
    assert _loaded(root).times(2) == 6
    assert len(said) == 1


def test_kernels_that_cannot_be_kept_are_said_with_the_reason_and_the_remedy(root: Path, said: list[str]) -> None:
    for path in (root / "prt_bake" / "__pycache__", root / "users"):
        path.write_bytes(b"")
    assert _loaded(root).times(2) == 6
    assert "in every run, since neither the package's folder nor the user's cache folder can be written" in said[0]
    assert "set NUMBA_CACHE_DIR to a folder that can" in said[0]


def test_kernels_of_edited_sources_are_said_not_to_be_kept(
    root: Path, said: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compilation, "STARTED", 0.0)
    assert _loaded(root).times(2) == 6
    assert said == ["compiling kernels; they are not kept, since a source was edited after this process began"]


def test_a_process_that_has_waited_too_long_compiles_itself(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compilation, "LONGEST_WAIT", 0.1)
    assert _loaded(root).times(2) == 6
    (lock,) = root.rglob("*.lock")
    with filelock.FileLock(lock):
        assert _hits_after_a_call(root, 6) == 0
    assert _hits_after_a_call(root, 6) == 1


def test_a_kernel_that_cannot_be_compiled_leaves_no_lock(root: Path) -> None:
    module = _loaded(root)
    with pytest.raises(TypingError):
        module.times(())
    (lock,) = root.rglob("*.lock")
    with filelock.FileLock(lock, timeout=0):
        pass


PROGRAM = """
import sys
from importlib import util
from pathlib import Path
from prt_bake.jit import compilation

root = Path(sys.argv[1])
compilation.ROOT, compilation.STARTED = root, float("inf")
sys.path[:0] = [str(root / "prt_bake")]
spec = util.spec_from_file_location("kernels", root / "prt_bake" / "kernels.py")
module = util.module_from_spec(spec)
print("ready", flush=True)
sys.stdin.readline()
spec.loader.exec_module(module)
print(*(module.times(eval(word)) for word in sys.argv[2:]), sum(module.times.stats.cache_misses.values()))
"""


def test_concurrent_processes_compile_each_kernel_once(root: Path) -> None:
    """Each process begins with another signature."""
    (root / "prt_bake" / "kernels.py").write_text(KERNELS.replace("prt_bake.constants", "constants"))
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    orders = (["2", "0.5", "2j"], ["0.5", "2", "2j"])
    running = [
        subprocess.Popen(
            [sys.executable, "-c", PROGRAM, str(root), *order],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
        )
        for order in orders
    ]
    for process in running:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
    for process in running:
        assert process.stdin is not None
        process.stdin.write("go\n")
        process.stdin.flush()
    answers = [process.communicate(timeout=600)[0].split() for process in running]
    assert [process.returncode for process in running] == [0, 0]
    assert [answer[:-1] for answer in answers] == [["6", "1.5", "6j"], ["1.5", "6", "6j"]]
    assert sum(int(answer[-1]) for answer in answers) == 3
    assert len(_cached(root)) == 3


def test_the_sources_of_a_kernel_are_all_modules_that_it_uses() -> None:
    found = {path.relative_to(PACKAGE).as_posix() for path in compilation.sources(PACKAGE / "tracer" / "kernels.py")}
    in_tracer = "walk connect surface/boundary surface/interface volume/media volume/tracking"
    used = {f"tracer/{name}.py" for name in in_tracer.split()}
    used |= {"geometry/embree.py", "mathematics/counter.py", "jit/compilation.py"}
    assert used <= found
    assert not {"tracer/estimate.py", "baking/bake.py", "cli/main.py"} & found


def test_no_kernel_uses_the_cache_of_numba() -> None:
    """numba's own cache would compare a kernel with its own file alone."""
    assert not [path.name for path in PACKAGE.rglob("*.py") if "cache=True" in path.read_text(encoding="utf-8")]
