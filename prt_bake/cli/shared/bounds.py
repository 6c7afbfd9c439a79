"""Bounds on a command's figures, for continuous integration: exit code 1 where one is not kept."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

FIGURES = ("mse", "relative_mse", "relative_rmse", "ssim", "ssim_quarter", "flip", "hdr_flip")
_FREE = "noise_free."

FailAbove = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=VALUE",
        help="Exit with 1 where the figure is larger, such as flip=0.03; noise_free.flip=0.03 where it surely would be "
        "without noise. May be given several times.",
        show_default=False,
    ),
]
FailBelow = Annotated[
    list[str] | None,
    typer.Option(metavar="NAME=VALUE", help="The same where it is smaller, such as ssim=0.95.", show_default=False),
]


@dataclass(frozen=True)
class Bounds:
    """Largest and smallest values of figures by name."""

    above: tuple[tuple[str, float], ...]
    below: tuple[tuple[str, float], ...]

    @classmethod
    def of(cls, above: list[str], below: list[str]) -> "Bounds":
        """Bounds as they are given, NAME=VALUE; raises typer.BadParameter for others."""
        return cls(tuple(map(_read, above)), tuple(map(_read, below)))

    def hold(self, image: Path, told: dict[str, Any]) -> None:
        """Raise PrtbakeError with every bound that a comparison's figures do not keep.

        Without noise the end of the interval that is nearer to the bound must be beyond it: what noise may explain
        fails nothing. A figure that is not known fails.
        """
        from formats.errors import PrtbakeError

        broken = [
            _sentence(name, value, bound, word, option)
            for bounds, sign, word, option in (
                (self.above, 1.0, "above", "--fail-above"),
                (self.below, -1.0, "below", "--fail-below"),
            )
            for name, bound in bounds
            if not sign * (value := _value(told, name, "low" if sign > 0.0 else "high")) <= sign * bound
        ]
        if broken:
            raise PrtbakeError(f"{image}: {'; '.join(broken)}")


def _read(text: str) -> tuple[str, float]:
    name, _, number = text.partition("=")
    try:
        value = float(number)
    except ValueError:
        value = math.nan
    if name.removeprefix(_FREE) not in FIGURES or not math.isfinite(value):
        raise typer.BadParameter(f"{text!r} is not NAME=VALUE, NAME one of {', '.join(FIGURES)} (or {_FREE}NAME)")
    return name, value


def _value(told: dict[str, Any], name: str, end: str) -> float:
    if not name.startswith(_FREE):
        return float(told[name])
    found = told.get("noise_free", {}).get(name.removeprefix(_FREE))
    return math.nan if found is None else float(found[end])


def _sentence(name: str, value: float, bound: float, word: str, option: str) -> str:
    if math.isnan(value):
        return f"{name} is not known, so {option} {name}={bound:g} cannot be kept"
    end = "" if not name.startswith(_FREE) else "at least " if word == "above" else "at most "
    return f"{name} is {end}{value:.4g}, {word} {bound:g} ({option})"
