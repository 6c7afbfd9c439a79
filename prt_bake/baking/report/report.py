"""`prtbake report bake`: error against run time for every method, and the error budget of a picture."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bakers.transport import on_mesh, prepared, refuse_foreign, transport_kind, up_to
from formats.atomic import refuse_unwritable, replacing
from formats.json_report import write_report
from formats.mesh import Mesh
from formats.scene import Scene
from prt_bake.baking.path_traced import PathTraced
from prt_bake.baking.report.bins import drawn_bins, fitted
from prt_bake.baking.report.budget import Part, error_budget
from prt_bake.baking.report.methods import LADDERS, Row, adaptive_rows, fixed_sample_rows
from prt_bake.baking.report.page import as_json, as_markdown, plot
from prt_bake.geometry.camera import Camera
from prt_bake.jit.limits import limited_threads

Array = NDArray[np.float64]
REFERENCE_DIRECTIONS = 1 << 13


def report_files(out: Path) -> list[Path]:
    """Paths of the report in the folder `out`: bake.md, bake.json and bake.png."""
    return [out / name for name in ("bake.md", "bake.json", "bake.png")]


def report_bake(
    transport: Any,
    mesh: Mesh,
    out: Path,
    *,
    scene: Scene | None = None,
    sky: NDArray[np.float32] | None = None,
    view: Camera | None = None,
    up: str = "y",
    degree: int = 2,
    rings: int = 16,
    sectors: int = 64,
    vertices: int = 12,
    points: int = 192,
    seconds: float = 120.0,
    precision: str = "float32",
    seed: int = 0,
    title: str = "A bake",
    say: Callable[[str], None] = lambda words: None,
) -> list[Path]:
    """Writes bake.md, bake.json and bake.png into the folder `out`, and returns their paths.

    transport: evaluates Ŝ, or estimates coefficients by random walks. scene: for a path-traced bake, and as the
    reference for the network's error. sky, view: a lat-long picture [H,W,3] and a camera for the error budget, which is
    omitted without them. seconds: approximate time of all methods together.

    Raises QueryError for a mesh that is not the transport's, PrtbakeError if the extra `evaluate` is not installed.
    """
    out.mkdir(parents=True, exist_ok=True)
    for file in report_files(out):
        refuse_unwritable(file)
    refuse_foreign(transport, mesh)
    bins = drawn_bins(mesh, rings, sectors, degree, vertices, seed)
    rows, parts = list[Row](), list[Part]()
    walks = PathTraced(scene) if scene is not None else None
    if transport_kind(transport) == "coefficients":
        walks = walks or transport
    own = [] if transport_kind(transport) == "coefficients" else [*LADDERS, "adaptive"]
    share = seconds / max(1, len(own) + (walks is not None))
    with limited_threads(walks if walks is not None else transport, 1):
        if own:
            unlimited = prepared(on_mesh(transport, mesh), precision, "cpu")
            fast = prepared(up_to(on_mesh(transport, mesh), degree), precision, "cpu")
            say(f"reference at {bins.count} view bins, {REFERENCE_DIRECTIONS} directions each")
            flat = np.repeat(mesh.positions[bins.vertices], sectors, axis=0), bins.outgoing.reshape(-1, 3)
            reference = fitted(fast, *flat, degree, REFERENCE_DIRECTIONS, seed)
            reference = reference.reshape(len(bins.vertices), sectors, -1, 3)
            for kind in LADDERS:
                say(kind)
                rows += fixed_sample_rows(fast, bins, kind, reference, share, seed)
            say("adaptive")
            rows += adaptive_rows(fast, bins, reference, share, seed)
        if walks is not None:
            say("path traced")
            rows += fixed_sample_rows(on_mesh(walks, mesh), bins, "walks", None, share, seed)
        if own and sky is not None and view is not None:
            say("error budget")
            parts = error_budget(
                unlimited, fast, mesh, sky, view, degree=degree, rings=rings, sectors=sectors, up=up, points=points,
                seed=seed, walks=None if walks is None else _walks(walks, degree, seed),
            )  # fmt: skip
    count = len(mesh.positions) * rings * sectors
    remarks = [
        f"{len(mesh.positions):,} vertices, {rings}×{sectors} view bins, degree {degree}. Measured on one core at "
        f"{bins.count} bins of {len(bins.vertices)} vertices; the reference has {REFERENCE_DIRECTIONS:,} directions a "
        "bin. A path counts as an evaluation, and the error of a path-traced bake is its own standard error. Adaptive "
        "bakes cover all bins of these vertices; their pilot is not counted."
    ]
    table, figures, plotted = report_files(out)
    with replacing(table) as part:
        part.write_text(as_markdown(title, rows, parts, count, remarks), encoding="utf-8")
    write_report(as_json(rows, parts, count), figures)
    plot(rows, plotted)
    return [table, figures, plotted]


def _walks(transport: Any, degree: int, seed: int) -> Callable[[Array, Array, int], tuple[Array, Array]]:
    def traced(positions: Array, outgoing: Array, walks: int) -> tuple[Array, Array]:
        estimate = transport.estimate_coefficients(positions, outgoing, degree, walks, seed)
        return estimate.mean, estimate.standard_error

    return traced
