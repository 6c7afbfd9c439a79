"""Options that have no effect with others are refused, so that nobody waits for what they ask for."""

from collections.abc import Collection

import typer


def refuse_ineffective(context: typer.Context, effective: Collection[str], where: str) -> None:
    """Refuse an option of the command line whose parameter is not among the `effective` ones.

    Raises typer.BadParameter that names the option and `where` it has no effect, such as "on a page".
    """
    refuse_given(context, {parameter.name for parameter in context.command.params}.difference(effective), where)


def refuse_given(context: typer.Context, ineffective: Collection[str | None], where: str) -> None:
    """Refuse an option of the command line whose parameter is among the `ineffective` ones, as `refuse_ineffective`."""
    for parameter in context.command.params:
        source = context.get_parameter_source(parameter.name or "")
        if source is not None and source.name == "COMMANDLINE" and parameter.name in ineffective:
            raise typer.BadParameter(f"{parameter.opts[0]}: has no effect {where}; omit it")
