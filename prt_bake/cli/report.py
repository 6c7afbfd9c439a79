"""`prtbake report`: what was measured, as a report of its own."""

import typer

from prt_bake.cli.report_paper import paper

report = typer.Typer(
    help="Measure a model, or all that the paper measures, and write down how good it is.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
)
report.command("paper")(paper)
