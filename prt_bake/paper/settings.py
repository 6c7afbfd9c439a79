"""How much work a report does."""

from dataclasses import dataclass, replace

from prt_bake.paper.scenes import BakeSettings


@dataclass(frozen=True)
class ReportSettings:
    """What decides the pictures and how long they take.

    Attributes:
        size: of the pictures, both ways.
        spp: samples a pixel of the network's pictures.
        reference_spp: walks a pixel of each reference; None where time decides.
        reference_minutes: time for each reference; None where walks decide.
        train_minutes: for a scene whose model is not there.
        importance_seconds: for fitting an importance module that is not there.
        most_bins, most_samples, most_subdivisions: bounds on every scene's bake.
        seed: of the references; what is compared with them is drawn from other numbers.
    """

    size: int = 512
    spp: int = 256
    reference_spp: int | None = 1024
    reference_minutes: float | None = None
    train_minutes: float = 10.0
    importance_seconds: float = 120.0
    most_bins: tuple[int, int] = (16, 64)
    most_samples: int = 1024
    most_subdivisions: int = 8
    device: str = "cpu"
    seed: int = 0

    def bake(self, asked: BakeSettings) -> BakeSettings:
        """A scene's bake within these bounds."""
        return BakeSettings(
            min(asked.subdivisions, self.most_subdivisions),
            min(asked.rings, self.most_bins[0]),
            min(asked.sectors, self.most_bins[1]),
            min(asked.samples, self.most_samples),
        )

    def quick(self) -> "ReportSettings":
        """The same with so little work that it shows the tables' form alone, not their figures."""
        return replace(
            self,
            size=min(self.size, 96),
            spp=min(self.spp, 64),
            reference_spp=64 if self.reference_minutes is None else None,
            train_minutes=min(self.train_minutes, 0.5),
            importance_seconds=min(self.importance_seconds, 10.0),
            most_bins=(4, 8),
            most_samples=32,
            most_subdivisions=0,
        )
