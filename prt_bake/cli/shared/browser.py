"""`prtbake view --browser`: the page of an asset in the browser, until Ctrl-C."""

import signal
from pathlib import Path

import typer

from prt_bake.cli.shared import signals
from prt_bake.cli.shared.ineffective import refuse_ineffective
from prt_bake.cli.shared.kinds import LIGHT, refuse_other_kinds
from prt_bake.cli.shared.progress import say

_EFFECTIVE = ("asset", "light", "mend", "browser", "port")


def view_in_browser(context: typer.Context, asset: Path, lights: list[str] | None, mend: bool, port: int) -> None:
    """Serve the page with an asset, or a .glb, on this machine; print its address, and open it if there is a display.

    Raises typer.BadParameter for options of the window, and what `site_files` and `show_page` raise.
    """
    refuse_ineffective(context, _EFFECTIVE, "on the page of --browser")
    kinds = ("mesh",) if asset.suffix.lower() == ".glb" else ("asset",)
    refuse_other_kinds({"ASSET": (asset, kinds), "--light": (lights, LIGHT)})
    from prt_bake.export.server import show_page
    from prt_bake.export.site import site_files

    files = site_files(asset, lights or (), mend=mend, say=say)
    if show_page(files, port, _print_address):
        signals.record(signal.SIGINT)


def _print_address(address: str) -> None:
    print(address, flush=True)
    say("the page is open for this machine alone; Ctrl-C ends it")
