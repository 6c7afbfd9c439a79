"""The scene file and the outcome of a command in the tests of the command line."""

from collections.abc import Callable
from typing import NamedTuple

SCENE = """
[object]
mesh = "sphere.ply"
unit = "cm"
[interface]
eta = 1.0
[medium]
sigma_t = 4.0
albedo = 0.9
"""


class Outcome(NamedTuple):
    code: int
    out: str
    err: str


Run = Callable[..., Outcome]
