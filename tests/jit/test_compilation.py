"""Kept kernels: never stale, never mixed, and never needed."""

import os
import subprocess
import sys
from importlib import util
from pathlib import Path
from types import ModuleType

import pytest

from prt_bake.jit import compilation

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
    _use(tmp_path, monkeypatch)
    return tmp_path


def _use(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compilation, "ROOT", root)
    monkeypatch.setenv("XDG_CACHE_HOME", str(root / "users"))
    for kept in (compilation.digest_at_start, compilation._read_once, compilation._writable_base):
        kept.cache_clear()


def _loaded(root: Path) -> ModuleType:
    """The kernel's module as a new process would load it."""
    compilation.digest_at_start.cache_clear()
    text = KERNELS.replace("from prt_bake.constants import FACTOR", (root / "prt_bake" / "constants.py").read_text())
    module = ModuleType("kernels")
    exec(compile(text, root / "prt_bake" / "kernels.py", "exec"), vars(module))
    return module


def _kept(root: Path) -> list[Path]:
    return sorted(root.rglob("*.kernel"))


def _hits(module: ModuleType) -> int:
    return sum(module.times.stats.cache_hits.values())


def test_a_kernel_is_kept_for_each_signature_and_met_again(root: Path) -> None:
    first, second = _loaded(root), _loaded(root)
    assert (first.times(2), first.times(0.5)) == (6, 1.5)
    assert len(_kept(root)) == 2
    assert (second.times(0.5), second.times(2)) == (1.5, 6)
    assert _hits(second) == 2


def test_an_edit_of_anything_that_it_draws_on_meets_no_old_kernel(root: Path) -> None:
    assert _loaded(root).times(2) == 6
    (root / "prt_bake" / "constants.py").write_text("FACTOR = 5\n")
    edited = _loaded(root)
    assert edited.times(2) == 10
    assert _hits(edited) == 0
    (root / "prt_bake" / "constants.py").write_text("FACTOR = 3\n")
    (root / "prt_bake" / "stranger.py").write_text("FACTOR = 7\n")
    back = _loaded(root)
    assert back.times(2) == 6
    assert _hits(back) == 1


def test_a_process_whose_sources_were_edited_neither_reads_nor_writes(root: Path) -> None:
    old = _loaded(root)
    (root / "prt_bake" / "constants.py").write_text("FACTOR = 5\n")
    assert old.times(2) == 6
    assert not _kept(root)


def test_a_damaged_kernel_is_compiled_again(root: Path) -> None:
    assert _loaded(root).times(2) == 6
    (path,) = _kept(root)
    whole = path.read_bytes()
    for damage in (b"", whole[: len(whole) // 2], b"shopping list"):
        path.write_bytes(damage)
        again = _loaded(root)
        assert again.times(2) == 6
        assert _hits(again) == 0


def test_the_states_written_last_are_kept_and_the_others_removed_without_harm(root: Path) -> None:
    running = _loaded(root)
    assert running.times(2) == 6
    (first,) = _kept(root)
    other = first.parent.with_name("prt_bake.neighbour-0123456789abcdef")
    other.mkdir()
    os.utime(first.parent, (1, 1))
    for factor in range(10, 10 + compilation.STATES_KEPT):
        (root / "prt_bake" / "constants.py").write_text(f"FACTOR = {factor}\n")
        assert _loaded(root).times(2) == 2 * factor
    assert len(_kept(root)) == compilation.STATES_KEPT
    assert not first.exists()
    assert other.is_dir()
    (root / "prt_bake" / "constants.py").write_text("FACTOR = 3\n")
    assert running.times(0.5) == 1.5
    assert len(_kept(root)) == compilation.STATES_KEPT


@pytest.mark.parametrize("users", [True, False], ids=["the user's cache", "nowhere"])
def test_where_the_package_cannot_be_written_to(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, users: bool
) -> None:
    """A file where a folder is wanted stands in for a folder that is read-only, as the tests may run as root."""
    (root / "prt_bake" / "__pycache__").write_bytes(b"")
    if not users:
        (root / "users").write_bytes(b"")
    module = _loaded(root)
    assert module.times(2) == 6
    assert [path.is_relative_to(root / "users") for path in _kept(root)] == [True] * users
    assert (module.times._cache.cache_path is None) is not users


PROGRAM = """
import sys, time
from importlib import util
from pathlib import Path
from prt_bake import compilation

root = Path(sys.argv[1])
compilation.ROOT = root
sys.path[:0] = [str(root / "prt_bake")]
spec = util.spec_from_file_location("kernels", root / "prt_bake" / "kernels.py")
module = util.module_from_spec(spec)
print("ready", flush=True)
sys.stdin.readline()
spec.loader.exec_module(module)
for word in sys.argv[2:]:
    print(module.times(eval(word)))
"""


def test_processes_that_compile_at_once_both_get_what_is_right(root: Path) -> None:
    """Each begins with another signature; a third process then meets both."""
    (root / "prt_bake" / "kernels.py").write_text(KERNELS.replace("prt_bake.constants", "constants"))
    environment = os.environ | {"PYTHONPATH": str(Path(compilation.__file__).parents[1])}
    orders = (["2", "0.5"], ["0.5", "2"])
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
    answers = [process.communicate("go\n", timeout=120)[0].split() for process in running]
    assert answers == [["6", "1.5"], ["1.5", "6"]]
    assert [process.returncode for process in running] == [0, 0]
    assert len(_kept(root)) == 2
    assert not list(root.rglob(".*"))


def test_a_kernels_digest_is_that_of_what_it_draws_on() -> None:
    package = Path(compilation.__file__).parent
    reached = {
        path.relative_to(package).as_posix() for path in compilation.modules_reached(package / "trainer" / "kernels.py")
    }
    drawn_on = {
        "kernels",
        "walk",
        "boundary",
        "tracking",
        "media",
        "interface",
        "counter",
        "connect",
        "embree",
        "compiled",
    }
    assert {f"trainer/{name}.py" for name in drawn_on} | {"compilation.py"} <= reached
    assert not {"trainer/estimate.py", "baking.py", "cli/main.py"} & reached


def test_every_kept_kernel_is_kept_this_way() -> None:
    """numba's own cache, which mixes kernels up, is nowhere asked for."""
    package = Path(compilation.__file__).parent
    assert not [path.name for path in package.rglob("*.py") if "cache=True" in path.read_text(encoding="utf-8")]
    assert util.find_spec("prt_bake.tracer.kernels") is not None
