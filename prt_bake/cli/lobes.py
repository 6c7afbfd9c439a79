"""`prtbake lobes`: adds to an asset what its harmonics leave out."""

from pathlib import Path
from typing import Annotated

import typer

from formats.atomic import existing
from prt_bake.cli.shared.kinds import refuse_other_kinds
from prt_bake.cli.shared.next_step import say_next_of_asset
from prt_bake.cli.shared.options import Device, Force, optional_output
from prt_bake.cli.shared.outputs import check_outputs, refuse_existing
from prt_bake.cli.shared.plan import lobes_sentence
from prt_bake.cli.shared.progress import reporting


def lobes(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="MODEL", help="Model of the same object: a network, or an ONNX or TorchScript function."
        ),
    ],
    asset: Annotated[Path, typer.Argument(metavar="ASSET", help="Asset that `prtbake bake` wrote.")],
    out: Annotated[
        Path | None,
        optional_output(
            "--output --out -o", "FILE", "Asset to write; by default NAME.lobes.h5 beside ASSET.", ".h5", ".hdf5"
        ),
    ] = None,
    most: Annotated[int, typer.Option(min=1, max=4, help="Most lobes in a view.")] = 4,
    workers: Annotated[int, typer.Option(min=1, max=1024, help="Threads.")] = 1,
    convention: Annotated[
        str | None,
        typer.Option(help="The 7 inputs of an ONNX or TorchScript MODEL, as for `prtbake bake`.", show_default=False),
    ] = None,
    device: Device = "cpu",
    force: Force = False,
) -> None:
    """Add lobes to an asset: narrow light that its harmonics leave out.

    Suns and windows then light an asset as they light its model. Coefficients are unchanged. Lobes are added as long as
    they gain something; an asset whose harmonics suffice gets none. Lobes that the asset has are replaced.
    """
    target = out or asset.with_name(f"{asset.stem}.lobes{asset.suffix}")
    check_outputs({"--output": target}, {"MODEL": existing(source), "ASSET": existing(asset)})
    refuse_existing([target], force)
    refuse_other_kinds({"MODEL": (source, ("model",)), "ASSET": (asset, ("asset",))})
    from formats.asset import read_asset
    from formats.asset.lobes import add_lobes_to_file
    from prt_bake.baking.lobes.addition import add_lobes
    from prt_bake.baking.sources import open_source, origin

    baked = read_asset(asset)
    transport = open_source(source, baked.mesh, device, convention)
    with reporting("lobes", "pilot on a few vertices") as show:
        found = add_lobes(
            baked, transport, most, workers=workers, device=device, progress=lambda done, of: show(done / of, "")
        )
    entry = {**found.provenance["lobes"], **origin(source)}
    add_lobes_to_file(asset, target, found.lobes, {"lobes": entry}, found.selftest)
    before = "" if baked.lobes is None else f"; they replace the {baked.lobes.count} that the asset had"
    print(f"{target}: {lobes_sentence(entry)}{before}")
    say_next_of_asset(target)
