"""`prtbake report`: the commands that measure a model, a bake or the paper's scenes."""

import typer

from prt_bake.cli.reports.bake import bake
from prt_bake.cli.reports.bases import bases
from prt_bake.cli.reports.paper import paper
from prt_bake.cli.reports.training import training
from prt_bake.cli.shared.help import Groups

report = typer.Typer(
    cls=Groups,
    help="Write a report on a model, a bake or the paper's scenes.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
)
report.command("training", no_args_is_help=True)(training)
report.command("paper")(paper)
report.command("bake", no_args_is_help=True)(bake)
report.command("bases", no_args_is_help=True)(bases)
