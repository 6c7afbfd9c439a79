"""`prtbake compress`: an asset in few bytes."""

from pathlib import Path
from typing import Annotated

import typer

from prt_bake.cli.shared.options import optional_output
from prt_bake.cli.shared.progress import reporting, say


def compress(
    context: typer.Context,
    asset: Annotated[Path, typer.Argument(metavar="ASSET", help="Asset that `prtbake bake` wrote.")],
    error: Annotated[
        float, typer.Option(help="Relative RMSE of the coefficients that may be added, from 1e-6 to below 1.")
    ] = 0.005,
    out: Annotated[
        Path | None,
        optional_output(
            "--output --out -o", "FILE", "Asset to write; NAME.compact.h5 beside the asset by default.", ".h5", ".hdf5"
        ),
    ] = None,
) -> None:
    """Write an asset in few bytes, within an error.

    Several forms are tried, and the smallest that meets the error is written. The compact asset is used like any other,
    and shaded as it is.
    """
    from prt_bake.baking.compress import compress_file

    target = out or asset.with_name(f"{asset.stem}.compact{asset.suffix}")
    with reporting("compress") as show:
        outcome = compress_file(asset, target, error, show, context.obj)
    if outcome.compact is None:
        say(f"{asset}: a compact form is not smaller; {target} is a copy of it")
        print(f"{target}: {outcome.after:,} bytes of coefficients in {outcome.seconds:.1f} s")
        return
    for row in outcome.asset.provenance["compression"]["tried"]:
        print(f"  {row['form']:<24} {row['size']:>13,} bytes  error {row['error']:.3%}  {row['seconds']:.1f} s")
    added = outcome.compact.added
    print(
        f"{target}: {outcome.after:,} bytes of coefficients, 1/{outcome.raw / outcome.after:.1f} of {outcome.raw:,} in "
        f"float32 ({outcome.before:,} in {asset.name}), in {outcome.seconds:.1f} s"
    )
    print(
        f"added relative RMSE {added.total:.3%} of {added.requested:.3%} asked for, 95th percentile over vertices "
        f"{added.percentile_95:.3%}, worst {added.worst:.3%}"
    )
