"""`prtbake compress`: makes an asset's file smaller within an error."""

from pathlib import Path
from typing import Annotated

import typer

from formats.atomic import existing
from prt_bake.cli.shared.kinds import refuse_other_kinds
from prt_bake.cli.shared.next_step import say_next_of_asset
from prt_bake.cli.shared.options import Force, optional_output
from prt_bake.cli.shared.outputs import check_outputs, refuse_existing
from prt_bake.cli.shared.progress import reporting, say


def compress(
    context: typer.Context,
    asset: Annotated[Path, typer.Argument(metavar="ASSET", help="Asset that `prtbake bake` wrote.")],
    error: Annotated[
        float, typer.Option(help="Relative RMSE that compression may add to the coefficients, from 1e-6 to below 1.")
    ] = 0.005,
    out: Annotated[
        Path | None,
        optional_output(
            "--output --out -o", "FILE", "Asset to write; by default NAME.compact.h5 beside ASSET.", ".h5", ".hdf5"
        ),
    ] = None,
    lobes: Annotated[bool, typer.Option(help="Keep the lobes, rounded within twice --error.")] = True,
    force: Force = False,
) -> None:
    """Compress an asset within an error.

    Tries several forms and writes the smallest that meets the error. Every command reads the compact asset, without
    unpacking it first.
    """
    target = out or asset.with_name(f"{asset.stem}.compact{asset.suffix}")
    check_outputs({"--output": target}, {"ASSET": existing(asset)})
    refuse_existing([target], force)
    refuse_other_kinds({"ASSET": (asset, ("asset",))})
    from prt_bake.baking.compress import compress_file

    with reporting("compress") as show:
        outcome = compress_file(asset, target, error, show, context.obj, lobes)
    if outcome.compact is None:
        say(f"{asset}: no compact form is smaller; {target} is a copy")
        print(f"{target}: {outcome.after:,} bytes of coefficients in {outcome.seconds:.1f} s")
        return
    tried = outcome.asset.provenance["compression"]["tried"]
    print("forms tried; the smallest within the error is written:")
    for line in dict.fromkeys(f"{row['form']:<24} {row['size']:>13,} bytes  error {row['error']:.3%}" for row in tried):
        print(f"  {line}")
    added = outcome.compact.added
    before, after = asset.stat().st_size, target.stat().st_size
    print(
        f"{target}: {after:,} bytes, 1/{before / after:.1f} of the {before:,} of {asset.name}, "
        f"in {outcome.seconds:.1f} s"
    )
    print(f"coefficients {outcome.after:,} bytes, in {asset.name} {outcome.before:,}")
    print(
        f"added relative RMSE {added.total:.3%} (at most {added.requested:.3%} requested), 95th percentile over "
        f"vertices {added.percentile_95:.3%}, worst {added.worst:.3%}"
    )
    rounding = outcome.asset.provenance["compression"].get("lobes_error")
    if rounding is not None:
        print(f"rounding the lobes adds {rounding:.3%}; --no-lobes omits them")
    say_next_of_asset(target)
