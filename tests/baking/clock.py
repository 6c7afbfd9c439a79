"""A clock that only the work of a bake advances, in place of the machine's."""

from typing import Any

import pytest

MODULES = (
    "bake",
    "plan",
    "adaptive.run",
    "adaptive.trials",
    "adaptive.pilot_pass",
    "adaptive.predicted_cost",
    "job.forecast",
    "job.work",
    "output.writing_time",
)


class Clock:
    """Replaces the module `time` in the modules that measure a bake."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 100.0
        for module in MODULES:
            monkeypatch.setattr(f"prt_bake.baking.{module}.time", self)

    def monotonic(self) -> float:
        """Seconds."""
        return self.now


class Timed:
    """A transport whose evaluations take `each` seconds by the clock; the first call takes `first` seconds more."""

    def __init__(self, transport: Any, clock: Clock, each: float, first: float = 0.0) -> None:
        self.transport, self.clock, self.each, self.extra = transport, clock, each, first

    def evaluate(self, incident: Any, positions: Any, outgoing: Any) -> Any:
        self.clock.now += self.each * incident.shape[0] * incident.shape[1] + self.extra
        self.extra = 0.0
        return self.transport.evaluate(incident, positions, outgoing)
