"""The settings of a report."""

from dataclasses import dataclass, replace

from prt_bake.paper.scenes import BakeSettings


@dataclass(frozen=True)
class ReportSettings:
    """The quality of the pictures and the time limits.

    Attributes:
        size: width and height of the pictures.
        spp: samples per pixel of the network's pictures.
        reference_spp: paths per pixel of each reference; None if only time limits it.
        reference_minutes: time of each reference; None if only the paths limit it.
        train_minutes: training time of a scene without a model.
        importance_seconds: fitting time of a missing importance module.
        most_bins, most_samples, most_subdivisions: limits of every scene's bake.
        device: that of the networks.
        seed: of the references; the pictures use independent seeds.
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

    def bake(self, settings: BakeSettings) -> BakeSettings:
        """Limit a scene's bake settings."""
        return BakeSettings(
            min(settings.subdivisions, self.most_subdivisions),
            min(settings.rings, self.most_bins[0]),
            min(settings.sectors, self.most_bins[1]),
            min(settings.samples, self.most_samples),
        )

    def quick(self) -> "ReportSettings":
        """Return settings for a quick test of the report, whose figures mean nothing."""
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
