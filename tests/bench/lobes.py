"""An asset compared with the network that it was baked from, on the object's pixels, without and with lobes.

    python -m tests.bench.lobes MODEL.pt ASSET.h5 --light SKY … [--eyes 8]

For eyes around the object, all visible vertices are compared, weighted by their share of the pixels. The network is
summed over 4,096 directions of the sky, its suns are taken in their own direction. Figures are relative RMSE of the
radiance in percent: all light in harmonics, suns apart (maximum entropy), lobes everywhere, and lobes but for suns in
the dark, the median of the eyes, the worst in brackets, and each; and the share of clamped light of the last.
"""

import argparse
import math
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import prt_bake as prt
from bakers.evaluation import values_at
from bakers.transport import on_mesh, prepared
from formats.asset import Asset
from prt_bake.bases.cells import cell_directions
from prt_bake.geometry.camera import Visibility
from prt_bake.lights.lighting import Lighting
from prt_bake.lights.sun_detection import split_lighting
from prt_bake.shading.vertices import shade_vertices
from prt_bake.shading.visible_points import find_visible_points, grid_offsets
from tests.bench.skies import studio

Array = NDArray[np.float64]

SIZE, CELLS, AT_ONCE = 96, 64, 64


def queries(asset: Asset, eyes: int) -> list[tuple[NDArray[np.int64], Array, Array]]:
    """Visible vertices [n], unit directions to the eye [n,3] and shares of the pixels [n], for each eye."""
    seen, visibility = [], Visibility(asset.mesh)
    for number in range(eyes):
        turn = 2.0 * math.pi * (number + 0.15) / eyes
        direction = np.array([math.sin(turn), 0.25, math.cos(turn)])
        camera = prt.fit_camera(asset.mesh, SIZE, SIZE, view="three-quarter-back")
        distance = np.linalg.norm(camera.eye - camera.target)
        camera = replace(camera, eye=camera.target + distance * direction / np.linalg.norm(direction))
        corners = asset.mesh.faces[find_visible_points(visibility, camera, grid_offsets(1)).faces].ravel()
        share = np.bincount(corners, minlength=len(asset.valid)) * asset.valid
        chosen = np.flatnonzero(share)
        outgoing = camera.eye - asset.mesh.positions[chosen]
        outgoing /= np.linalg.norm(outgoing, axis=1, keepdims=True)
        seen.append((chosen, outgoing, share[chosen] / share.sum()))
    return seen


class Network:
    """Radiance of a network at some queries."""

    def __init__(self, transport: prt.NeuralBSSRDF, asset: Asset, vertices: NDArray[np.int64], outgoing: Array) -> None:
        self._transport = prepared(on_mesh(transport, asset.mesh), "float32", "cpu")
        self._positions, self._outgoing = asset.mesh.positions[vertices], outgoing
        self._cells = cell_directions(CELLS, "y")

    @cached_property
    def _table(self) -> Array:
        count = len(self._positions)
        parts = [self._values(self._cells[None], slice(n, n + AT_ONCE)) for n in range(0, count, AT_ONCE)]
        return np.concatenate(parts)

    def radiance(self, lighting: Lighting) -> Array:
        """Radiance [n,3] under a lighting."""
        split = split_lighting(lighting)
        radiance = np.zeros(self._positions.shape)
        if split.skies:
            sky = Lighting(split.skies, ()).radiance(self._cells) * (4.0 * math.pi / len(self._cells))
            radiance += np.einsum("ndc,dc->nc", self._table, sky)
        for sun in split.suns:
            radiance += self._values(sun.direction[None, None], slice(None))[:, 0] * sun.irradiance
        return radiance

    def _values(self, directions: Array, rows: slice) -> NDArray[np.float32]:
        positions, outgoing = self._positions[rows], self._outgoing[rows]
        values = values_at(self._transport, directions, np.zeros(len(positions), np.int64), positions, outgoing)
        return np.asarray(values, np.float32)


def main() -> None:
    """Print a line for each light and eye."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path)
    parser.add_argument("asset", type=Path)
    parser.add_argument("--light", nargs="+", default=["studio"])
    parser.add_argument("--eyes", type=int, default=8)
    args = parser.parse_args()
    asset, model = prt.read_asset(args.asset), prt.load_model(args.model)
    seen = queries(asset, args.eyes)
    truths = [Network(model, asset, vertices, outgoing) for vertices, outgoing, _ in seen]
    for name in args.light:
        lighting = prt.read_lighting(name.split("+")) if name != "studio" else studio_lighting()
        plain = replace(asset, lobes=None)
        ways = (plain, "plain"), (plain, "split"), (asset, "split"), (asset, "split")
        lights = [prt.light_for(lit, lighting, treatment) for lit, treatment in ways]
        lights[2] = replace(lights[2], harmonics=lights[2].whole, suns=())
        squares, clamped = np.zeros((len(seen), len(ways) + 1)), 0.0
        for eye, ((vertices, outgoing, share), truth) in enumerate(zip(seen, truths, strict=True)):
            towards = np.ones((len(asset.valid), 3))
            towards[vertices] = outgoing
            visible = np.zeros(len(asset.valid), np.bool_)
            visible[vertices] = True
            exact = truth.radiance(lighting)
            squares[eye, -1] = (share[:, None] * exact**2).sum()
            for way, ((lit, _), light) in enumerate(zip(ways, lights, strict=True)):
                shading = shade_vertices(lit, light, towards, visible)
                squares[eye, way] = (share[:, None] * (shading.radiance[vertices] - exact) ** 2).sum()
            clamped += shading.clamped / len(seen)
        errors = 100.0 * np.sqrt(squares[:, :-1] / squares[:, -1:])
        names = "plain", "split", "lobes everywhere", "lobes"
        middle, worst = np.median(errors, axis=0), errors.max(axis=0)
        row = "  ".join(f"{way} {m:.1f} ({w:.1f})" for way, m, w in zip(names, middle, worst, strict=True))
        each = "  ".join("/".join(f"{error:.1f}" for error in eye) for eye in errors)
        print(f"{Path(name).stem:24} {row} %   clamped {100.0 * clamped:.2f} %   eyes: {each}", flush=True)


def studio_lighting() -> Lighting:
    """The generated studio of `tests.bench.skies`."""
    from prt_bake.lights.lighting import as_lighting

    return as_lighting(studio(), "y", 0.0)


if __name__ == "__main__":
    main()
