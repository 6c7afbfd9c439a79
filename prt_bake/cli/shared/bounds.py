"""Bounds on the figures of `prtbake compare`, for continuous integration: exit code 1 if one is broken."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

FIGURES = ("mse", "relative_mse", "relative_rmse", "ssim", "ssim_quarter", "flip", "hdr_flip")
_NOISE_FREE = "noise_free."

FailAbove = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=VALUE",
        help="Exit with 1 if the figure is larger, such as flip=0.03. noise_free.flip=0.03 tests the interval without "
        "noise. Can be repeated.",
        show_default=False,
    ),
]
FailBelow = Annotated[
    list[str] | None,
    typer.Option(metavar="NAME=VALUE", help="Exit with 1 if it is smaller, such as ssim=0.95.", show_default=False),
]


@dataclass(frozen=True)
class Bounds:
    """Upper bounds (--fail-above) and lower bounds (--fail-below) by the figure's name."""

    above: tuple[tuple[str, float], ...]
    below: tuple[tuple[str, float], ...]

    @classmethod
    def of(cls, above: list[str], below: list[str]) -> "Bounds":
        """Parse texts NAME=VALUE; raises typer.BadParameter for any other text."""
        return cls(tuple(map(_read, above)), tuple(map(_read, below)))

    def refuse_broken(self, image: Path, figures: dict[str, Any]) -> None:
        """Raise PrtbakeError with every bound that the figures break.

        A noise-free figure breaks a bound only if its whole interval lies beyond it. A missing figure breaks every
        bound.
        """
        from formats.errors import PrtbakeError

        broken = [
            _sentence(name, value, bound, side, option)
            for bounds, sign, side, option in (
                (self.above, 1.0, "above", "--fail-above"),
                (self.below, -1.0, "below", "--fail-below"),
            )
            for name, bound in bounds
            if not sign * (value := _value(figures, name, "low" if sign > 0.0 else "high")) <= sign * bound
        ]
        if broken:
            raise PrtbakeError(f"{image}: {'; '.join(broken)}")


def _read(text: str) -> tuple[str, float]:
    name, _, number = text.partition("=")
    try:
        value = float(number)
    except ValueError:
        value = math.nan
    if name.removeprefix(_NOISE_FREE) not in FIGURES or not math.isfinite(value):
        known = ", ".join(FIGURES)
        raise typer.BadParameter(f"{text!r} is not NAME=VALUE with NAME one of {known} (or {_NOISE_FREE}NAME)")
    return name, value


def _value(figures: dict[str, Any], name: str, end: str) -> float:
    if not name.startswith(_NOISE_FREE):
        return float(figures[name])
    interval = figures.get("noise_free", {}).get(name.removeprefix(_NOISE_FREE))
    return math.nan if interval is None else float(interval[end])


def _sentence(name: str, value: float, bound: float, side: str, option: str) -> str:
    if math.isnan(value):
        return f"{name} is unknown, which breaks {option} {name}={bound:g}"
    end = "" if not name.startswith(_NOISE_FREE) else "at least " if side == "above" else "at most "
    return f"{name} is {end}{value:.4g}, {side} {bound:g} ({option})"
