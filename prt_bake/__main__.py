"""`python -m prt_bake` is `prtbake`."""

from prt_bake.cli.__main__ import run

if __name__ == "__main__":
    run()
