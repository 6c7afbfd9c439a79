"""Every public name of `prt_bake` has an example in its docstring, and the example works."""

import doctest
from pathlib import Path

import numpy as np
import pytest

import prt_bake as prt

WITHOUT_EXAMPLE = {"sh", "sphere"}
"""Names that still lack an example; this set must become empty."""


@pytest.mark.parametrize("name", prt.__all__)
def test_the_example_in_the_docstring_works(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = getattr(prt, name).__doc__ or ""
    examples = doctest.DocTestParser().get_doctest(text, {"prt": prt, "np": np}, name, None, None)
    if name in WITHOUT_EXAMPLE:
        assert not examples.examples, f"{name} has an example: remove it from WITHOUT_EXAMPLE"
        return
    assert examples.examples, f"{name} has no example in its docstring"
    monkeypatch.chdir(tmp_path)
    report: list[str] = []
    doctest.DocTestRunner().run(examples, out=report.append)
    assert not report, "".join(report)
