"""Pruning of bakes: the evaluations, bytes and seconds that it saves, and the error that it adds.

    python -m tests.bench.pruning [--error 0.01] [--only WORDS]

Each scene is baked to a file without and with pruning. Columns are evaluations (thousands), kilobytes and seconds, each
without and with pruning, and the evaluations that the plan predicted. `adds` is the relative error that pruning adds,
from fits over 4,096 directions, and the asset's estimate of it; `error` is the total error and its estimate.
"""

import argparse
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from formats.asset import Asset, read_asset
from formats.mesh import Mesh
from prt_bake import bake
from prt_bake.baking import bake as baking
from prt_bake.mathematics import sh, sphere
from tests.bakers.transports import Array, Counting, Edged, Lobed, exact, icosphere
from tests.baking.prunable_scenes import Flat, Grey, Nearly, doubled, finned, nested, pierced, soup, two_skinned

RINGS, SECTORS = 8, 32
TOLERATED = 0.25
"""Share of the requested error that each pruned item may add."""
EYE = np.array([0.5, 3.0, 1.0])


@dataclass(frozen=True)
class Scene:
    """A transport on a mesh, and the items that may be pruned from its bake."""

    transport: Any
    mesh: Mesh
    items: tuple[str, ...] = ()
    more: dict[str, Any] = field(default_factory=dict)
    hidden: NDArray[np.bool_] | None = None
    """Vertices [V] that are invisible from outside by construction."""


def scenes(error: float) -> dict[str, Scene]:
    """Every scene by name."""
    mesh, found = icosphere(2), dict[str, Scene]()
    hiding = {
        "unseen: a ball in a ball": nested(1.0, 0.5),
        "unseen: three balls in one another": nested(1.0, 0.7, 0.4),
        "unseen: shells that nearly touch": nested(1.0, 1.0 - 1e-4),
        "unseen: nothing, a gap of 30 % of a face": pierced(0.3),
        "unseen: nothing, a gap of 1 % of a face": pierced(0.01),
        "unseen: nothing, fins, a bow tie, a degenerate face": finned(),
        "unseen: nothing, all faces twice": two_skinned(),
    }
    for name, (hollow, hidden) in hiding.items():
        found[name] = Scene(Lobed(), hollow, ("unseen",), hidden=hidden)
    found["duplicates: all vertices twice"] = Scene(Lobed(), doubled(), ("duplicates",))
    found["duplicates: a soup of faces"] = Scene(Lobed(), soup(), ("duplicates",))
    found["views: no dependence"] = Scene(Edged(), mesh, ("views",))
    found["bands: the highest is zero"] = Scene(Flat(), mesh, ("bands",))
    found["channels: equal"] = Scene(Grey(), mesh, ("channels",))
    found["all: grey, no dependence on the view"] = Scene(Grey(), mesh, baking.ITEMS)
    for item, name in (("views", "changing"), ("bands", "banded"), ("channels", "coloured")):
        for share in (0.5, 2.0):
            near = Nearly(**{name: share * TOLERATED * error})
            found[f"{item}: {share:g} times the tolerance"] = Scene(near, mesh, (item,))
        for size in (0.3, 1.5 * error):
            near = Nearly(**{name: size}, at=mesh.positions[101])
            found[f"{item}: error {size:g} at a single vertex"] = Scene(near, mesh, (item,))
    light = np.random.default_rng(2).uniform(-0.2, 1.0, size=(9, 3))
    found["for a light"] = Scene(Lobed(), mesh, more={"for_light": light})
    linear = light * (np.arange(9) < 4)[:, None]
    found["for a light of degree 1"] = Scene(Lobed(), mesh, more={"for_light": linear})
    found["for an eye"] = Scene(Lobed(), mesh, more={"for_eye": EYE})
    found["for a light and an eye"] = Scene(Lobed(), mesh, more={"for_light": light, "for_eye": EYE})
    return found


def baked(scene: Scene, error: float, out: Path, **more: Any) -> tuple[Asset, float, float, float]:
    """The asset, its independently counted evaluations in thousands, its kilobytes and seconds."""
    counted, began = Counting(scene.transport), time.perf_counter()
    bake(counted, scene.mesh, rings=RINGS, sectors=SECTORS, error=error, out=out, **more).close()
    seconds = time.perf_counter() - began
    return read_asset(out), counted.evaluations / 1e3, out.stat().st_size / 1e3, seconds


def truth_for(scene: Scene) -> Array:
    """Coefficients [V,B,K,3] for the asset's light and eye, or radiance [V,B,1,3]."""
    if "for_eye" in scene.more:
        towards = EYE - scene.mesh.positions
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        harmonics = sh.evaluate(sphere.fibonacci(4096), 2)
        incident = np.broadcast_to(sphere.fibonacci(4096), (len(towards), 4096, 3))
        values = scene.transport.evaluate(incident, scene.mesh.positions, towards)
        truth = (np.linalg.pinv(harmonics) @ values)[:, None]
    else:
        truth = exact(scene.transport, scene.mesh, RINGS, SECTORS)
    if (light := scene.more.get("for_light")) is not None:
        truth = np.einsum("vbkc,kc->vbc", truth, light)[:, :, None]
    return np.asarray(truth)


def pruned(truth: Array, kept: tuple[int, ...]) -> Array:
    """The best approximation of the truth by an asset of shape `kept`, in the truth's shape."""
    found = truth.mean(axis=1, keepdims=True) if kept[1] == 1 else truth
    found = found.mean(axis=3, keepdims=True) if kept[3] == 1 else found
    padded = np.zeros(truth.shape)
    padded[:, :, : kept[2]] = found[:, :, : kept[2]]
    return padded


def relative_rmse(error: Array, truth: Array) -> float:
    """The root of Σ error² over Σ truth²."""
    return float(np.sqrt((error**2).sum() / (truth**2).sum()))


def outcome(scene: Scene, asset: Asset) -> str:
    """The items that were pruned, and the vertices found hidden."""
    found = [f"pruned {', '.join(item['item'] for item in asset.left_out)}"] if asset.left_out else ["all kept"]
    found += asset.provenance.get("needed_after_all", [])
    if scene.hidden is not None:
        unseen, hidden = ~asset.valid.astype(bool), scene.hidden
        found.append(f"{unseen.sum()} hidden of {hidden.sum()}, {(unseen & ~hidden).sum()} wrongly")
    return ", ".join(found)


def measure(name: str, scene: Scene, error: float, folder: Path) -> None:
    """Print the row of a scene."""
    more = {"leave_out": scene.items, **scene.more}
    plan = baking.plan(scene.transport, scene.mesh, rings=RINGS, sectors=SECTORS, error=error, **more)
    _unpruned, *before = baked(scene, error, folder / "unpruned.h5")
    asset, *after = baked(scene, error, folder / "pruned.h5", **more)
    good, truth = asset.valid.astype(bool), truth_for(scene)
    if "for_eye" in scene.more:
        good &= scene.mesh.positions @ EYE > 1.0
    values = np.asarray(asset.coefficients, np.float64)
    padded = np.zeros(truth.shape)
    padded[:, :, : values.shape[2]] = values
    adds = relative_rmse((truth - pruned(truth, values.shape))[good], truth[good])
    estimated = asset.provenance["estimated_relative_rmse"]
    true = relative_rmse((padded - truth)[good], truth[good])
    sizes = "".join(f"{one:>8,.0f}{two:>7,.0f}" for one, two in zip(before[:2], after[:2], strict=True))
    print(
        f"{name:44}{sizes}{plan.evaluations / 1e3:>8,.0f}{before[2]:7.1f}{after[2]:6.1f}{adds:8.2%}"
        f"{estimated.get('left_out', 0.0):7.2%}{true:8.2%}{estimated['total']:7.2%}  {outcome(scene, asset)}",
        flush=True,
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--error", type=float, default=0.01)
    parser.add_argument("--only", default="")
    args = parser.parse_args()
    heads = f"{'evals':>8}{'less':>7}{'kB':>8}{'less':>7}{'planned':>8}{'s':>7}{'less':>6}{'adds':>8}{'est.':>7}"
    print(f"{'scene':44}{heads}{'error':>8}{'est.':>7}")
    for name, scene in scenes(args.error).items():
        if args.only in name:
            with tempfile.TemporaryDirectory() as folder:
                measure(name, scene, args.error, Path(folder))


if __name__ == "__main__":
    main()
