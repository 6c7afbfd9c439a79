"""Adaptive bakes of difficult transports: whether they reach the error, estimate it well and report problems.

    python -m tests.bench.bake_stability [--error 0.01] [--seeds 2] [--only WORDS]

Meshes have 12 or 42 vertices; the truth is a fit over at least 4,096 directions. `true` is the relative RMSE of the
object and `95 %` its 95th percentile over vertices, both for the worst seed. `est./true` and `within`, the share of
bins with an error below 1.96 `standard_error`, are ranges over the seeds. Problems are: ERROR, above 1.1 times the
requested error; ESTIMATE, wrong by more than 20 % (40 % for fewer than 10,000 bins); WITHIN, not 88 to 99 %. They are
followed by what the bake reported.
"""

import argparse
import tempfile
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from formats.asset import Asset
from formats.errors import PrtbakeError
from formats.mesh import Mesh
from prt_bake import bake
from prt_bake.baking.report.summary import bake_report
from tests.bakers.transports import Array, Counting, exact, icosphere
from tests.baking.bad_transports import Case, cases

NEGLIGIBLE = 1e-3
"""Share of the requested error below which the estimate need not be accurate."""


@dataclass(frozen=True)
class Figures:
    """Figures of one bake."""

    true: float
    worst: float
    estimated: float
    within: float
    evaluations: float
    reported: frozenset[str]


def measured(case: Case, mesh: Mesh, truth: Array, error: float, seed: int, folder: Path) -> Figures:
    """The figures of one bake against the truth [V,B,K,3]; vertices whose truth is not finite are ignored."""
    counted, more = Counting(case.transport), dict(case.more)
    if case.stored:
        more["out"] = folder / f"{seed}.h5"
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        settings: dict[str, Any] = {"degree": case.degree, "rings": case.rings, "sectors": case.sectors, "seed": seed}
        asset = bake(case.transport if "precision" in more else counted, mesh, error=error, **settings, **more)
    valid, finite = asset.valid.astype(bool), np.isfinite(truth).all(axis=(1, 2, 3))
    good, missed = valid & finite, int((valid & ~finite).sum())
    difference = np.asarray(asset.coefficients[...], np.float64)[good] - truth[good]
    squares = (difference**2).sum(axis=(1, 2, 3)), (truth[good] ** 2).sum(axis=(1, 2, 3))
    by_vertex = np.sqrt(np.divide(*squares, out=np.zeros(len(difference)), where=squares[1] > 0.0))
    within = np.sqrt((difference**2).mean(axis=(2, 3))) <= 1.96 * asset.standard_error[...][good]
    estimated = asset.provenance["estimated_relative_rmse"]["total"]
    reported = _reported(asset) | {f"warning: {each.message}" for each in caught}
    reported |= {f"{missed} vertices not finite, not reported"} if missed else set()
    true = (
        float(np.sqrt(squares[0].sum() / squares[1].sum()))
        if squares[1].sum() > 0.0
        else float(np.abs(difference).max())
    )
    spent = asset.provenance["evaluations"] / (len(truth) * truth.shape[1])
    worst = float(np.percentile(by_vertex, 95))
    return Figures(true, worst, estimated, float(within.mean()), spent, frozenset(reported))


def _reported(asset: Asset) -> set[str]:
    report = bake_report(asset)
    found = {"not reached"} if report["error_reached"] is False else set()
    if bad := report["vertices_not_finite"]["count"]:
        found.add(f"{bad} vertices not finite")
    if "rounding" in report["estimated_relative_rmse"]:
        found.add(f"rounding {report['estimated_relative_rmse']['rounding']:.2%}")
    return found | ({report["storage_note"].split(":")[1].strip()} if "storage_note" in report else set())


def problems(each: Figures, error: float, bins: int) -> str:
    """The figures that are out of range."""
    found, allowed = [], 0.2 if bins >= 10_000 else 0.4
    if not each.true <= 1.1 * error:
        found.append("ERROR")
    if each.true > NEGLIGIBLE * error and not 1.0 - allowed < each.estimated / each.true < 1.0 + allowed:
        found.append("ESTIMATE")
    if each.true > NEGLIGIBLE * error and not 0.88 <= each.within <= 0.99:
        found.append("WITHIN")
    return " ".join(found)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--error", type=float, default=0.01)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--only", default="")
    args = parser.parse_args()
    heads = f"{'true':>8}{'95 %':>8}{'est.':>8}{'est./true':>11}{'within':>9}{'per bin':>9}"
    print(f"{'case':52}{heads}  problems; reported")
    for name, case in cases().items():
        if args.only not in name:
            continue
        mesh = case.mesh or icosphere(case.subdivisions)
        with np.errstate(invalid="ignore"):
            reference = case.reference or case.transport
            truth = exact(reference, mesh, case.rings, case.sectors, case.degree, case.directions)
        with tempfile.TemporaryDirectory() as folder:
            try:
                rows = [measured(case, mesh, truth, args.error, seed, Path(folder)) for seed in range(args.seeds)]
            except (PrtbakeError, ArithmeticError, ValueError) as refused:
                print(f"{name:52}{type(refused).__name__}: {refused}", flush=True)
                continue
        bins = truth.shape[0] * truth.shape[1]
        worst = max(rows, key=lambda row: row.true)
        ratios = [row.estimated / row.true for row in rows if row.true > 0.0] or [1.0]
        wrong = sorted({word for row in rows for word in problems(row, args.error, bins).split()})
        reported = sorted(set().union(*(row.reported for row in rows)))
        print(
            f"{name:52}{worst.true:8.3%}{max(row.worst for row in rows):8.2%}{worst.estimated:8.3%}"
            f"{min(ratios):6.2f}–{max(ratios):.2f}{min(r.within for r in rows):5.0%}–{max(r.within for r in rows):.0%}"
            f"{np.mean([row.evaluations for row in rows]):9.1f}  {' '.join(wrong)}; {', '.join(reported)}",
            flush=True,
        )


if __name__ == "__main__":
    main()
