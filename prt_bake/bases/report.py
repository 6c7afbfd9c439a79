"""`prtbake report bases`: how much of a transport each basis of light represents, by numbers for a view bin."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.atomic import refuse_unwritable, replacing
from formats.json_report import write_report
from formats.mesh import Mesh
from prt_bake.baking.path_traced import PathTraced
from prt_bake.bases.cells import cell_directions, turned_skies
from prt_bake.bases.page import as_json, as_markdown, plot
from prt_bake.bases.picture import Picture, flip, visible
from prt_bake.bases.points import Points, drawn_points
from prt_bake.bases.rows import Estimate, Row, Values, every_basis, measured
from prt_bake.bases.sources import OfModel, OfScene, Source
from prt_bake.geometry import camera

Array = NDArray[np.float64]


def report_files(out: Path) -> list[Path]:
    """Paths of the report in the folder `out`: bases.md, bases.json and bases.png."""
    return [out / name for name in ("bases.md", "bases.json", "bases.png")]


def report_bases(
    transport: Any,
    mesh: Mesh,
    lights: dict[str, NDArray[np.float32]],
    out: Path,
    *,
    up: str = "y",
    points: int = 192,
    size: int = 48,
    seed: int = 0,
    title: str = "Bases of light",
    say: Callable[[str], None] = lambda words: None,
) -> list[Path]:
    """Write bases.md, bases.json and bases.png into the folder `out`, and return their paths.

    Args:
        transport: a network, a `PathTraced` scene, or anything else that evaluates Ŝ.
        mesh: its object.
        lights: lat-long pictures [H,W,3] by name.
        out: the folder.
        up: the up axis of the object.
        points: how many points errors are measured at; learned bases come from twice as many others.
        size: width and height of the picture under the first light; 0 for none. Scenes get none.
        seed: of the points.
        title: of the table.
        say: is called with what is done next.

    Raises:
        QueryError: the transport does not evaluate Ŝ, or the mesh is not its own.
        PrtbakeError: the extra `evaluate` is not installed.
    """
    out.mkdir(parents=True, exist_ok=True)
    for file in report_files(out):
        refuse_unwritable(file)
    traced = isinstance(transport, PathTraced)
    source: Source = OfScene(transport.scene) if traced else OfModel(transport, mesh, up)
    directions = cell_directions(source.cells, up)
    say(f"Ŝ at {3 * points} points, {len(directions)} directions each")
    values = _values(source, *drawn_points(mesh, points, seed, source.squares))
    training = training_values(source, mesh, 2 * points, seed + 1)
    skies = [turned_skies(picture, source.cells) for picture in lights.values()]
    picture = _picture(source, mesh, up, size, skies[0]) if size and not traced else None
    rows, flips = list[Row](), dict[Row, Estimate]()
    for basis in every_basis(training, directions, skies, source.lobes):
        say(f"{basis.name}, {basis.numbers} numbers")
        rows.append(measured(basis, values, skies, seed))
        if picture is not None:
            flips[rows[-1]] = flip(basis, picture, 0)
    settings = {"points": points, "cells": len(directions), "path_traced": traced, "seed": seed}
    markdown, numbers, image = report_files(out)
    with replacing(markdown) as part:
        part.write_text(as_markdown(title, rows, list(lights), flips, settings), encoding="utf-8")
    write_report(as_json(rows, list(lights), flips, settings), numbers)
    plot(rows, list(lights), image)
    return [markdown, numbers, image]


def training_values(source: Source, mesh: Mesh, count: int, seed: int) -> Array:
    """Ŝ [count,M,3] at importance-sampled points, times the roots of their weights: sums of squares are then right."""
    points, weights = drawn_points(mesh, count, seed, source.squares)
    return source.values(points, 1)[0] * np.sqrt(weights)[:, None, None]


def _values(source: Source, points: Points, weights: Array) -> Values:
    fitted, *checks = source.values(points, 3)
    return Values(fitted, (checks[0], checks[1]), source.own_lobes(fitted, points), weights)


def _picture(source: Source, mesh: Mesh, up: str, size: int, skies: Array) -> Picture:
    points, pixels = visible(mesh, camera.fit(mesh, size, size, up=up, view="three-quarter-back"))
    return Picture(points, pixels, _values(source, points, np.ones(len(points.faces))), skies)
