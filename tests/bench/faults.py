"""Every reader under damaged files: no traceback, no hang, no memory beyond 20 times the file and 200 MB.

    python -m tests.bench.faults [--inputs 100000] [--seed 0] [--only obj ply …] [--keep FOLDER] [--corpus FOLDER]

Valid small files of each kind are mutated: bits, bytes, numbers and lengths changed, parts repeated, removed or taken
from another file. A mutated file that reaches lines of the readers which no file has reached is mutated further
(`lines` counts them); the corpus of such files is kept in a folder, if it is given, and a later run begins with it.

A reader may return, warn, or raise a PrtbakeError. Everything else is a fault: another exception, a read of more than
five seconds, memory, a process that dies. The files of faults are kept in FOLDER, if it is given.
"""

import argparse
import hashlib
import multiprocessing
import queue
import random
import resource
import shutil
import sys
import tempfile
import time
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

from formats.errors import PrtbakeError
from tests.bench.small_files import KINDS, Read

SECONDS = 5.0
MEGABYTES, TIMES = 200, 20
_NUMBERS = (b"0", b"-1", b"nan", b"1e999", b"4294967295", b"-2147483649", b"99999999999999999999", b"1e-320")
_WORDS = (b"\xff\xff\xff\xff", b"\x00\x00\x00\x00", b"\xff\xff\xff\x7f", b"\x00\x00\x00\x80", b"\x01", b"\xff" * 8)

_PRODUCT = tuple(str(Path(__file__).parents[2] / room) for room in ("formats", "prt_bake"))

Report = tuple[str, str]
"""The outcome of a read and, for faults, its description."""


def mutated(content: bytes, other: bytes, draw: random.Random) -> bytes:
    """The content with one to four changes."""
    data = bytearray(content)
    for _ in range(draw.choice((1, 1, 2, 4))):
        at = draw.randrange(len(data)) if data else 0
        span = min(draw.choice((1, 4, 16, 256, 4096)), len(data) - at)
        match draw.randrange(7):
            case 0 if data:
                data[at] ^= 1 << draw.randrange(8)
            case 1:
                word = draw.choice(_WORDS)
                data[at : at + len(word)] = word
            case 2:
                data[at:at] = data[at : at + span]
            case 3:
                del data[at : at + span]
            case 4:
                del data[at:]
            case 5:
                start = draw.randrange(len(other)) if other else 0
                data[at : at + span] = other[start : start + span]
            case _:
                _change_number(data, at, draw)
    return bytes(data)


def _change_number(data: bytearray, at: int, draw: random.Random) -> None:
    """Replace the next digits in a text, or a byte."""
    while at < len(data) and not 48 <= data[at] <= 57:
        at += 1
    end = at
    while end < len(data) and 48 <= data[end] <= 57:
        end += 1
    data[at:end] = draw.choice(_NUMBERS)


class Lines:
    """The lines of the product that have run in a `with` block, in this thread."""

    def __init__(self) -> None:
        self.seen = set[tuple[Any, int]]()

    def __enter__(self) -> None:
        sys.settrace(self._enter)

    def __exit__(self, *_: object) -> None:
        sys.settrace(None)

    def _enter(self, frame: Any, event: str, argument: object) -> Any:
        return self._line if frame.f_code.co_filename.startswith(_PRODUCT) else None

    def _line(self, frame: Any, event: str, argument: object) -> Any:
        self.seen.add((frame.f_code, frame.f_lineno))
        return self._line


def outcome(read: Read, path: Path) -> Report:
    """Read a file and classify what happens."""
    before, began = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.perf_counter()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            read(path)
        found = "read"
    except PrtbakeError:
        found = "refused"
    except BaseException as fault:
        return "fault", f"{type(fault).__name__}: {str(fault)[:120]}"
    seconds = time.perf_counter() - began
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024.0
    if seconds > SECONDS:
        return "fault", f"{seconds:.1f} s"
    if grown > MEGABYTES + TIMES * path.stat().st_size / 2**20:
        return "fault", f"{grown:.0f} MB"
    return found, ""


def work(kind: str, seed: int, inputs: int, folder: str, corpus: Path | None, results: Any) -> None:
    """Read mutated files of one kind; each path is announced before it is read, so that a death has a culprit."""
    make, read = KINDS[kind]
    parents = [path.read_bytes() for path in make(Path(folder))]
    parents += [path.read_bytes() for path in sorted(corpus.iterdir())] if corpus and corpus.is_dir() else []
    draw = random.Random(f"{kind} {seed}")
    suffix = "".join(next(iter(make(Path(folder)))).suffixes)
    lines = Lines()
    for number in range(inputs):
        path = Path(folder) / f"input{number % 2}{suffix}"
        content = mutated(draw.choice(parents), draw.choice(parents), draw)
        path.write_bytes(content)
        results.put(("begins", str(path)))
        before = len(lines.seen)
        with lines:
            found, what = outcome(read, path)
        if found == "fault":
            results.put(("begins", shutil.copy(path, path.with_stem(f"fault{number}"))))
        elif len(lines.seen) > before:
            parents.append(content)
            if corpus:
                corpus.mkdir(parents=True, exist_ok=True)
                (corpus / hashlib.sha256(content).hexdigest()[:16]).write_bytes(content)
        results.put((found, what))
    results.put(("ended", str(len(lines.seen))))


def tested(
    kind: str, seed: int, inputs: int, keep: Path | None, corpus: Path | None
) -> tuple[Counter[str], Counter[str]]:
    """Outcomes, and faults by description, of mutated files of one kind; a dead or hanging process is replaced."""
    outcomes, faults, done = Counter[str](), Counter[str](), 0
    context = multiprocessing.get_context("spawn")
    while done < inputs:
        with tempfile.TemporaryDirectory() as folder:
            results = context.Queue()
            process = context.Process(target=work, args=(kind, seed + done, inputs - done, folder, corpus, results))
            process.start()
            done += _follow(process, results, outcomes, faults, keep)
            process.kill()
            process.join()
    return outcomes, faults


def _follow(process: Any, results: Any, outcomes: Counter[str], faults: Counter[str], keep: Path | None) -> int:
    """Count the outcomes of a process until it ends, dies or hangs; returns their number."""
    done, path = 0, ""
    while True:
        try:
            found, what = results.get(timeout=60.0 if not path else 4.0 * SECONDS)
        except queue.Empty:
            found, what = "fault", "hangs" if process.is_alive() else f"dies with {process.exitcode}"
            if not path:
                raise RuntimeError("the process did not start") from None
        if found == "ended":
            outcomes["lines"] = int(what)
            return done
        if found == "begins":
            path = what
            continue
        done += 1
        outcomes[found] += 1
        if found == "fault":
            faults[what] += 1
            if keep is not None and faults[what] == 1:
                keep.mkdir(parents=True, exist_ok=True)
                shutil.copy(path, keep / f"{len(list(keep.iterdir())):03d}-{Path(path).name}")
            if what.startswith(("hangs", "dies")):
                return done


def main() -> None:
    """Print a row for each kind of file, and its faults."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=100_000, help="mutated files of each kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", choices=sorted(KINDS), default=list(KINDS))
    parser.add_argument("--keep", type=Path, help="folder for the files of faults")
    parser.add_argument("--corpus", type=Path, help="folder for the files that reach new lines")
    args = parser.parse_args()
    print(f"{'kind':14}{'inputs':>9}{'read':>9}{'refused':>9}{'faults':>9}{'lines':>9}{'seconds':>9}")
    for kind in args.only:
        began = time.perf_counter()
        corpus = args.corpus / kind if args.corpus else None
        outcomes, faults = tested(kind, args.seed, args.inputs, args.keep, corpus)
        counts = "".join(f"{outcomes[name]:>9,}" for name in ("read", "refused", "fault", "lines"))
        print(f"{kind:14}{args.inputs:>9,}{counts}{time.perf_counter() - began:>9.0f}", flush=True)
        for what, count in faults.most_common():
            print(f"    {count:,} times: {what}", flush=True)


if __name__ == "__main__":
    main()
