"""The summary of `prtbake make` as a page: what was made, how good it is, and the commands that do it by hand."""

from collections.abc import Iterator

from formats.atomic import replacing
from prt_bake.cli.making.record import ASSET, PAGE, PICTURE, SUMMARY, TURNTABLE, Record
from prt_bake.cli.shared.progress import in_words


def write_page(record: Record) -> None:
    """Write summary.md."""
    with replacing(record.folder / PAGE) as part:
        part.write_text("\n".join(_lines(record)) + "\n", encoding="utf-8")


def _lines(record: Record) -> Iterator[str]:
    minutes, files = record.settings["minutes"], {file for step in record.steps for file in step.files}
    yield f"# {record.settings['scene']}"
    yield ""
    yield f"Made in {in_words(record.seconds)} of {in_words(60.0 * minutes)}, under {record.settings['light']}."
    yield ""
    yield from (f"![{name}]({name})" for name in (PICTURE, TURNTABLE) if name in files)
    yield ""
    yield f"* Error of the coefficients {record.figures['error of the coefficients']}"
    yield (
        f"* {record.figures['vertices']:,} vertices, {record.figures['view bins']:,} view bins, harmonics of degree "
        f"{record.figures['degree']}; all figures: {SUMMARY}"
    )
    yield "* A longer training (more --minutes) lowers the error of the network, which usually is the largest"
    yield ""
    yield "| step | time | files |"
    yield "|---|---|---|"
    for step in record.steps:
        sizes = ", ".join(f"{file} ({_size(size)})" for file, size in step.files.items())
        yield f"| {step.name} | {in_words(step.seconds)} | {sizes or step.note} |"
    yield ""
    yield "The same by hand:"
    yield ""
    yield from (f"    {step.command}" for step in record.steps)
    yield ""
    yield f"To look at it: `prtbake view {ASSET}` in this folder."


def _size(count: int) -> str:
    return f"{count / 1e6:,.1f} MB" if count >= 1e5 else f"{count / 1e3:,.1f} kB"
