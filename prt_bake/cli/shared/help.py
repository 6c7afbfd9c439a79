"""The list of commands that `prtbake --help` prints: by group, with whole sentences."""

from inspect import cleandoc
from typing import Any

from typer.core import TyperGroup


class Groups(TyperGroup):
    """A list of commands, by the `rich_help_panel` of each. Typer's own list has no groups, and cuts long sentences."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the commands above the options."""
        groups: dict[str, list[tuple[str, str]]] = {}
        for name in self.list_commands(ctx):
            command = self.get_command(ctx, name)
            assert command is not None
            group = str(getattr(command, "rich_help_panel", None) or "Commands")
            summary = " ".join(cleandoc(command.help or "").partition("\n\n")[0].split())
            groups.setdefault(group, []).append((name, summary))
        column = max(len(name) for rows in groups.values() for name, _ in rows)
        for group, rows in groups.items():
            with formatter.section(group):
                formatter.write_dl([(name.ljust(column), summary) for name, summary in rows])
        records = (parameter.get_help_record(ctx) for parameter in self.get_params(ctx))
        with formatter.section("Options"):
            formatter.write_dl([record for record in records if record is not None])
