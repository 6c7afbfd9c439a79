"""`prtbake sample`: writes path-traced training samples."""

from pathlib import Path
from typing import Annotated

import typer

from formats.errors import PrtbakeError
from prt_bake.cli.shared.kinds import refuse_other_kinds
from prt_bake.cli.shared.next_step import say_next, unused
from prt_bake.cli.shared.options import Force, Seed, output_option
from prt_bake.cli.shared.outputs import check_outputs, refuse_existing
from prt_bake.cli.shared.progress import reporting, stopping


def sample(
    scene: Annotated[Path, typer.Argument(metavar="SCENE.toml", help="Scene to path trace.")],
    output: Annotated[Path, output_option("SAMPLES.h5", ".h5", ".hdf5")],
    count: Annotated[int, typer.Option(min=1, help="Number of queries.")],
    walks: Annotated[int, typer.Option(min=2, help="Paths per query, shared by its light directions.")] = 8,
    directions: Annotated[int, typer.Option(min=1, help="Light directions per query.")] = 8,
    seed: Seed = 0,
    force: Force = False,
) -> None:
    """Path trace training queries and write them with their noise.

    `prtbake train SCENE.toml --samples SAMPLES.h5` learns from them. Ctrl-C keeps the queries finished so far. Each
    --seed draws different queries.
    """
    check_outputs({"--output": output}, {"SCENE": scene})
    refuse_existing([output], force)
    refuse_other_kinds({"SCENE": (scene, ("scene",))})
    from formats.scene import read_scene
    from prt_bake.trainer.samples.record import record_samples

    with reporting("sample") as show, stopping() as stop:
        done = record_samples(
            read_scene(scene),
            output,
            count,
            walks=walks,
            directions=directions,
            seed=seed,
            progress=lambda done, total: show(done / total, f"{done:,} of {total:,} queries"),
            stop=stop,
        )
    print(f"{output}: {done:,} queries of {directions} directions, {done * walks:,} paths")
    if done < count:
        raise PrtbakeError(f"{output}: the sampling was stopped; the file holds {done:,} of {count:,} queries")
    say_next("prtbake", "train", scene, "--samples", output, "-o", unused(output.with_name(f"{scene.stem}.pt")))
