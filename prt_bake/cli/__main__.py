"""`python -m prt_bake.cli` is the same as `prtbake`."""

from prt_bake.cli.main import run

run()
