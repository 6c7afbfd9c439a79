"""`python -m prt_bake.cli`: the same as `prtbake`."""

from prt_bake.cli.main import run

run()
