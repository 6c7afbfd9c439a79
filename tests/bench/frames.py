"""Cost of a frame, compared with gathering the same cache lines, a memory copy and a plain NumPy shader in one run.

    python -m tests.bench.frames [--only vertices|visible|bins|threads|storage|small|compact|light]
    python -m tests.bench.frames --asset baked.h5 [--compact baked.c.h5]

The object is a ring of V vertices with random coefficients of degree 2 and three channels, and the eye circles it. At
16×64 view bins 300,000 vertices would take 16.6 GB of float16, so large objects have fewer bins, still more bytes than
any cache holds.

`lines` is a numba loop on as many threads that reads one number of each cache line that a frame reads, in the frame's
order, from a precomputed list of lines. `rows` sums all numbers of these rows, and `copy` copies as many bytes
sequentially. The measurements alternate within each round. Times are medians over rounds (`least`: the shortest frame),
shares are medians of the ratios within a round. `--clock cpu` measures the processor time of all threads, for busy
machines.
"""

import argparse
import time
from collections.abc import Callable

import numpy as np
from numba import get_num_threads, njit, prange, set_num_threads

from formats.asset import Asset, read_asset
from formats.mesh import Mesh
from prt_bake.baking.compress import compress
from prt_bake.mathematics import sh, sphere
from prt_bake.shading.frames.frames import Frames
from tests.shading.assets import asset_of
from tests.shapes import ring

LINE = 64
ROUNDS = 21
SOME = 1 << 22
VERTICES = 300_000
CLOCK = time.perf_counter
BINS = {"float16": (8, 32), "float32": (4, 32)}


def random_asset(vertices: int, rings: int, sectors: int, storage: str = "float16", degree: int = 2) -> Asset:
    """An asset on a ring with repeated random coefficients; the time of a frame does not depend on them."""
    side = round(np.sqrt(vertices))
    mesh = ring(around=-(-vertices // side), across=side)
    return filled_asset(mesh, rings, sectors, storage, degree)


def filled_asset(mesh: Mesh, rings: int, sectors: int, storage: str, degree: int) -> Asset:
    shape = (len(mesh.positions), rings * sectors, sh.count(degree), 3)
    some = np.random.default_rng(0).normal(0.3, 0.2, SOME).astype(storage)
    coefficients = np.empty(np.prod(shape), storage)
    for first in range(0, len(coefficients), SOME):
        coefficients[first : first + SOME] = some[: len(coefficients) - first]
    return asset_of(
        mesh, coefficients.reshape(shape), rings, sectors, degree, standard_error=np.zeros((shape[0], 1), np.float32)
    )


def light_for(asset: Asset) -> np.ndarray:
    return np.random.default_rng(1).normal(size=(sh.count(asset.degree), 3))


def eyes(asset: Asset, count: int) -> list[np.ndarray]:
    angles = 2 * np.pi * np.arange(count) / count
    return [asset.mesh.center + 1.5 * asset.mesh.diagonal * np.array([np.cos(a), 0.4, np.sin(a)]) for a in angles]


@njit(parallel=True)
def gather_lines(numbers, starts, sums):
    threads, size = sums.shape[0], starts.shape[0]
    for t in prange(threads):
        total = numbers[0] * 0
        for i in range(t * size // threads, (t + 1) * size // threads):
            total += numbers[starts[i]]
        sums[t, 0] += total


@njit(parallel=True)
def gather_rows(rows, which, sums):
    threads, size = sums.shape[0], which.shape[0]
    for t in prange(threads):
        total = rows[0, 0] * 0
        for i in range(t * size // threads, (t + 1) * size // threads):
            row = rows[which[i]]
            for k in range(row.shape[0]):
                total += row[k]
        sums[t, 0] += total


def rows_read(asset: Asset, eye: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Rows [n,4] that a frame reads; the mean over ring 0 replaces the rows that a view near the pole would add."""
    towards = eye - asset.mesh.positions[vertices]
    towards /= np.linalg.norm(towards, axis=1)[:, None]
    local = sphere.to_local(towards, asset.mesh.normals[vertices], asset.tangents[vertices])
    at = sphere.bin_coordinates(local, asset.rings, asset.sectors)
    pairs = [(ring, sector) for ring in (at.ring_low, at.ring_high) for sector in (at.sector_low, at.sector_high)]
    bins = np.stack([ring * asset.sectors + sector for ring, sector in pairs], axis=1)
    return vertices[:, None] * asset.rings * asset.sectors + bins


def lines_of(rows: np.ndarray, row_bytes: int) -> np.ndarray:
    """Each cache line once, in the order of the rows."""
    first, last = rows * row_bytes // LINE, (rows * row_bytes + row_bytes - 1) // LINE
    spans = np.arange(int((last - first).max()) + 1)
    lines = np.where(first[..., None] + spans <= last[..., None], first[..., None] + spans, -1)
    lines = np.sort(lines.reshape(len(rows), -1), axis=1)
    new = np.ones(lines.shape, np.bool_)
    new[:, 1:] = lines[:, 1:] != lines[:, :-1]
    return lines[new & (lines >= 0)]


def numpy_shader(asset: Asset, light: np.ndarray, eye: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    towards = eye - asset.mesh.positions[vertices]
    towards /= np.linalg.norm(towards, axis=1)[:, None]
    local = sphere.to_local(towards, asset.mesh.normals[vertices], asset.tangents[vertices])
    bins, weights = sphere.bin_weights(local, asset.rings, asset.sectors)
    four = asset.coefficients[vertices[:, None], bins[:, :4]].astype(np.float32)
    return np.maximum(np.einsum("nm,nmkc,kc->nc", weights[:, :4].astype(np.float32), four, light.astype(np.float32)), 0)


Calls = dict[str, Callable[[int], object]]


def measured(calls: Calls, rounds: int = ROUNDS) -> tuple[dict[str, float], dict[str, np.ndarray]]:
    """Median seconds of each call, and all of them."""
    spent: dict[str, list[float]] = {name: [] for name in calls}
    for call in calls.values():
        call(0)
    for turn in range(rounds):
        for name, call in calls.items():
            began = CLOCK()
            call(turn)
            spent[name].append(CLOCK() - began)
    return {name: float(np.median(times)) for name, times in spent.items()}, {
        name: np.array(times) for name, times in spent.items()
    }


def comparison(asset: Asset, visible: np.ndarray | None = None, *, folded: bool = False, slow: bool = True) -> Calls:
    """A frame and the loops that it is compared with, for eyes that circle the object."""
    views = eyes(asset, 4)
    frames, light = Frames(asset), light_for(asset)
    frames.light(light)
    if folded:
        frames.fold()
    vertices = np.flatnonzero(asset.valid if visible is None else visible)
    flat = asset.coefficients.reshape(-1)
    flat = flat.view(np.uint16) if flat.dtype == np.float16 else flat
    row = asset.coefficients[0, 0].size
    read = [rows_read(asset, eye, vertices) for eye in views]
    starts = [lines_of(rows, row * flat.itemsize) * (LINE // flat.itemsize) for rows in read]
    moved = np.empty((2, len(starts[0]) * LINE // 8))
    sums = np.zeros((get_num_threads(), 8), flat.dtype)
    calls: Calls = {
        "frame": lambda turn: frames.draw(views[turn % 4], visible),
        "lines": lambda turn: gather_lines(flat, starts[turn % 4], sums),
        "rows": lambda turn: gather_rows(flat.reshape(-1, row), read[turn % 4].reshape(-1), sums),
        "copy": lambda _: np.copyto(moved[0], moved[1]),
    }
    if slow:
        calls["NumPy"] = lambda turn: numpy_shader(asset, light, views[turn % 4], vertices)
    return calls


def row_of(name: str, asset: Asset, calls: Calls, shown: int, rounds: int = ROUNDS) -> None:
    medians, times = measured(calls, rounds)
    figures = "".join(f"{1e3 * medians[key]:10.3f}" if key in medians else f"{'':10}" for key in HEAD)
    shares = [float(np.median(times[key] / times["frame"])) for key in ("lines", "rows")]
    size = getattr(asset.coefficients, "nbytes", 0) / 1e9
    least = 1e3 * float(times["frame"].min())
    print(
        f"{name:30}{size:7.2f} GB{least:10.3f}{figures}{1e9 * medians['frame'] / shown:10.1f}"
        f"{shares[0]:9.0%}{shares[1]:9.0%}",
        flush=True,
    )


HEAD = ("frame", "lines", "rows", "copy", "NumPy")


def heading(title: str) -> None:
    names = "".join(f"{name:>10}" for name in HEAD)
    print(f"\n{title}\n{'':40}{'least':>10}{names}{'ns/vertex':>10}{'of lines':>9}{'of rows':>9}", flush=True)


def by_vertices() -> None:
    heading("Vertices, all visible, float16, 8×32 bins, ms")
    for vertices in (3_000, 30_000, 100_000, VERTICES):
        asset = random_asset(vertices, 8, 32)
        row_of(f"{vertices:,} vertices", asset, comparison(asset), vertices)


def by_visible() -> None:
    heading("Visible vertices of 300,000, float16, 8×32 bins, ms")
    asset = random_asset(VERTICES, 8, 32)
    count = len(asset.valid)
    for shown in (300, 3_000, 30_000, 150_000):
        visible = np.zeros(count, np.bool_)
        visible[np.random.default_rng(2).choice(count, shown, replace=False)] = True
        row_of(f"{shown:,} scattered", asset, comparison(asset, visible), shown)
        visible[:] = False
        visible[count // 3 : count // 3 + shown] = True
        row_of(f"{shown:,} contiguous", asset, comparison(asset, visible), shown)


def by_bins() -> None:
    heading("View bins, 30,000 vertices, float16, ms")
    for rings, sectors in ((1, 1), (4, 8), (8, 16), (8, 32), (16, 64)):
        asset = random_asset(30_000, rings, sectors)
        row_of(f"{rings}×{sectors} bins", asset, comparison(asset), len(asset.valid))


def by_threads() -> None:
    heading("Threads, 100,000 vertices, float16, 8×32 bins, ms")
    asset, most = random_asset(100_000, 8, 32), get_num_threads()
    for threads in range(1, most + 1):
        set_num_threads(threads)
        row_of(f"{threads} threads", asset, comparison(asset), len(asset.valid))
    set_num_threads(most)


def by_storage() -> None:
    heading("Storage, 300,000 vertices, all visible, ms")
    for storage, (rings, sectors) in BINS.items():
        asset = random_asset(VERTICES, rings, sectors, storage)
        shown = len(asset.valid)
        name = f"{storage}, {rings}×{sectors} bins"
        row_of(name, asset, comparison(asset, slow=False), shown)
    for storage in BINS:
        asset = random_asset(100_000, 4, 32, storage)
        medians, times = measured(modes(asset))
        print(
            f"100,000 vertices of 4×32 {storage}: {1e3 * medians['moving']:.2f} ms a frame"
            + "".join(
                f", {name} {1e3 * medians[name]:.2f} ms: {np.median(times['moving'] / times[name]):.1f} times less"
                for name in ("folded", "held")
            ),
            flush=True,
        )


def modes(asset: Asset) -> Calls:
    """Frames with moving eye and light, with the light fixed (folded), and with the eye fixed (held)."""
    views, light = eyes(asset, 360), light_for(asset)
    moving, folded, held = Frames(asset), Frames(asset), Frames(asset)
    for frames in (moving, folded, held):
        frames.light(light)
    folded.fold()
    held.hold(views[0])
    return {
        "moving": lambda turn: moving.draw(views[turn % 360]),
        "folded": lambda turn: folded.draw(views[turn % 360]),
        "held": lambda _: held.draw(views[0]),
    }


def of_small() -> None:
    """Consecutive frames of a slowly moving eye, as in a preview; the other measurements evict a frame's data from the
    caches.
    """
    print("\n3,000 visible vertices at 16×64 bins, consecutive frames")
    for vertices in (3_000, 30_000):
        asset = random_asset(vertices, 16, 64)
        visible = np.zeros(len(asset.valid), np.bool_)
        visible[np.random.default_rng(2).choice(len(visible), 3_000, replace=False)] = True
        least, median, most = 1e3 * np.quantile(in_a_row(asset, visible), (0.0, 0.5, 0.95))
        print(f"of {vertices:7,}: {median:.3f} ms (least {least:.3f}, 95 % are below {most:.3f})", flush=True)


def in_a_row(asset: Asset, visible: np.ndarray) -> np.ndarray:
    frames, views = Frames(asset), eyes(asset, 360)
    frames.light(light_for(asset))
    return measured({"frame": lambda turn: frames.draw(views[turn % 360], visible)}, 2_000)[1]["frame"]


def of_compact() -> None:
    """The same object in all storage formats: smooth transfer on a ring, compressed to 0.5 %."""
    mesh = ring(around=60, across=50)
    raw = filled_asset(mesh, 16, 64, "float32", 2)
    rng = np.random.default_rng(4)
    x, y, z = raw.directions.T
    smooth = np.stack([x**i * y**j * z**k for i in range(4) for j in range(4 - i) for k in range(4 - i - j)])
    mixed = np.einsum("vpk,pb->vbk", rng.normal(size=(len(mesh.positions), len(smooth), 27)), smooth, optimize=True)
    raw.coefficients[:] = mixed.reshape(raw.coefficients.shape)
    of_assets({"float32": raw, "compact": compress(raw, 0.005)})


def of_assets(assets: dict[str, Asset]) -> None:
    raw = next(iter(assets.values()))
    assets = dict(assets)
    if isinstance(raw.coefficients, np.ndarray):
        other = "float16" if raw.coefficients.dtype == np.float32 else "float32"
        assets[other] = Asset(**{**vars(raw), "coefficients": raw.coefficients.astype(other)})
    calls: Calls = {}
    for name, asset in assets.items():
        folding, holding = (1e3 * preparing(asset, method) for method in ("fold", "hold"))
        print(f"{name}: folding takes {folding:.1f} ms, holding {holding:.1f} ms")
        calls |= {f"{name}, {mode}": call for mode, call in modes(asset).items()}
    medians, _ = measured(calls, 51)
    print(f"{len(raw.valid):,} vertices, {raw.rings}×{raw.sectors} bins, all visible")
    for name, seconds in medians.items():
        print(f"{name:20}{1e3 * seconds:9.3f} ms{1e9 * seconds / len(raw.valid):9.1f} ns per vertex")


def preparing(asset: Asset, method: str) -> float:
    """Seconds of folding or holding the second time, when it is compiled and its memory is allocated."""
    frames = Frames(asset)
    for _ in range(2):
        frames.light(light_for(asset))
        began = CLOCK()
        if method == "fold":
            frames.fold()
        else:
            frames.hold(eyes(asset, 1)[0])
    return CLOCK() - began


def of_light() -> None:
    """The times to set and to rotate a light, and of frames with and without back-face culling."""
    asset = random_asset(100_000, 8, 32)
    frames, light = Frames(asset), light_for(asset)
    frames.light(light)
    frames.turn(1.0)
    views = eyes(asset, 4)
    calls: Calls = {
        "light": lambda _: frames.light(light),
        "turn": lambda turn: frames.turn(7.0 * turn),
        "frame": lambda turn: frames.draw(views[turn % 4]),
        "frame, culled": lambda turn: frames.draw(views[turn % 4], cull=True),
    }
    medians, _ = measured(calls, 51)
    print("\n" + ", ".join(f"{name} {1e6 * seconds:.0f} µs" for name, seconds in medians.items()), flush=True)


PARTS: dict[str, Callable[[], None]] = {
    "vertices": by_vertices,
    "visible": by_visible,
    "bins": by_bins,
    "threads": by_threads,
    "storage": by_storage,
    "small": of_small,
    "compact": of_compact,
    "light": of_light,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=list(PARTS), nargs="+", default=list(PARTS))
    parser.add_argument("--asset", help="a baked asset instead of random ones")
    parser.add_argument("--compact", help="the same asset, compressed")
    parser.add_argument("--clock", choices=("wall", "cpu"), default="wall")
    args = parser.parse_args()
    global CLOCK
    CLOCK = time.process_time if args.clock == "cpu" else CLOCK
    if args.asset:
        named = {"as baked": args.asset, "compact": args.compact}
        of_assets({name: read_asset(path) for name, path in named.items() if path})
        return
    for part in args.only:
        PARTS[part]()


if __name__ == "__main__":
    main()
