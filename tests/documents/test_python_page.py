"""docs/reference/python.md lists every public name."""

import re

import prt_bake as prt
from tests import ROOT

PAGE = (ROOT / "docs" / "reference" / "python.md").read_text(encoding="utf-8")
LISTED = re.findall(r"^\.\. auto(?:function|class|exception):: prt_bake(?:\.|::)([\w.]+)$", PAGE, re.MULTILINE)


def test_every_public_name_is_listed_once() -> None:
    assert sorted(name for name in LISTED if "." not in name) == sorted(set(prt.__all__) - {"sh", "sphere"})


def test_every_function_of_the_two_modules_is_listed() -> None:
    for module in (prt.sh, prt.sphere):
        name = module.__name__.split(".")[-1]
        own = {each for each, value in vars(module).items() if getattr(value, "__module__", "") == module.__name__}
        own |= set(getattr(module, "__all__", ()))
        assert {f"{name}.{each}" for each in own if not each.startswith("_")} <= set(LISTED)
