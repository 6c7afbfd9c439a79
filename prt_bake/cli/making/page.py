"""The summary of `prtbake make` as a page: what was made, how good it is, and the commands that do it by hand."""

from collections.abc import Iterator

from formats.atomic import replacing
from prt_bake.cli.making.record import ASSET, COMPACT, MODEL, PAGE, PICTURE, SUMMARY, TURNTABLE, Record
from prt_bake.cli.making.steps import COMPRESSION_ERROR, portable
from prt_bake.cli.shared.plan import lobes_sentence
from prt_bake.cli.shared.progress import in_words


def write_page(record: Record) -> None:
    """Write summary.md."""
    with replacing(record.folder / PAGE) as part:
        part.write_text("\n".join(_lines(record)) + "\n", encoding="utf-8")


def results(record: Record) -> Iterator[str]:
    """Yield what was made, and what each file is for."""
    percent = 100.0 * COMPRESSION_ERROR
    uses = {
        PICTURE: "a picture",
        TURNTABLE: "a turntable",
        ASSET: "the asset, for `prtbake view`, `prtbake shade` and Python",
        COMPACT: f"the same asset, to pass on: coefficients at most {percent:g} % off; every command reads it",
    }
    yield f"{record.folder / PAGE}: error of the asset {record.figures['error of the coefficients']}"
    yield from (
        f"{record.folder / name}: {size}, {uses[name]}" for name, size in record.sizes().items() if name in uses
    )


def _lines(record: Record) -> Iterator[str]:
    sizes = record.sizes()
    yield f"# {record.settings['scene']}"
    yield ""
    yield f"Made in {in_words(record.spent)} of {in_words(60.0 * record.minutes)}, under {record.pictures['light']}."
    yield ""
    yield from (f"![{name}]({name})" for name in (PICTURE, TURNTABLE) if name in sizes)
    yield ""
    if keys := record.settings.get("keys"):
        yield "* Scene: " + ", ".join(f"{name} = {value}" for name, value in keys.items())
    yield f"* Error of the asset {record.figures['error of the coefficients']}"
    yield (
        f"* {record.figures['vertices']:,} vertices, {record.figures['view bins']:,} view bins, harmonics of degree "
        f"{record.figures['degree']}; all figures: {SUMMARY}"
    )
    yield (
        "* A longer training lowers the error of the network, which usually is the largest: the same `prtbake make` "
        "with twice the `--minutes` trains on"
    )
    yield f"* {_lobes(record)}"
    yield ""
    yield "| step | time | files |"
    yield "|---|---|---|"
    for step in record.steps:
        files = ", ".join(f"{file} ({sizes[file]})" for file in step.files)
        yield f"| {step.name} | {in_words(step.seconds)} | {files or step.note} |"
    yield ""
    yield from _by_hand(record)
    yield ""
    yield f"To look at it: `prtbake view {ASSET}` in this folder."


def _by_hand(record: Record) -> Iterator[str]:
    """The commands of the steps."""
    commands = [step.command for step in record.steps]
    named = [portable(line) for line in commands]
    copied = "; `sky.hdr` is the shipped sky, which `prtbake example DIR` copies" if named != commands else ""
    yield f"The same by hand{copied}:"
    yield ""
    yield from (f"    {line}" for line in named)


def _lobes(record: Record) -> str:
    """What the asset has of narrow light, and how to add it."""
    entry = record.figures["lobes"]
    added = "" if entry["lobes_in_a_view"] else f"; `prtbake lobes {MODEL} {ASSET}` adds them, if they gain anything"
    return f"Narrow light, {lobes_sentence(entry)}{added}"
