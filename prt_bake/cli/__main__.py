"""The console script `prtbake`; `python -m prt_bake.cli` is the same."""

import gc
import signal
import sys

from prt_bake.cli.shared import signals


def run() -> None:
    """Run the command line. After Ctrl-C or SIGTERM, errors of libraries whose import it broke off are not shown."""

    def interrupt(number: int, _: object) -> None:
        signals.record(number)
        raise KeyboardInterrupt

    for number in signals.STOPPING:
        signal.signal(number, interrupt)  # temporary files are removed as the exception passes
    try:
        from prt_bake.cli.main import main

        code = main()
    except BaseException:
        if not signals.exit_code(0):
            raise
        print(f"prtbake: {signals.sentence()}", file=sys.stderr)
        code = signals.exit_code(1)
    gc.freeze()  # Python searches all objects for cycles when it ends, which takes seconds
    sys.exit(code)


if __name__ == "__main__":
    run()
