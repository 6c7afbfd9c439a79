"""The fit of a NeRFactor to pictures.

The light is a lat-long picture of 16 × 32 pixels. A pixel of a view is the sum over them of L V f cos⁺ ΔΩ, clipped to
[0, 1] and encoded as sRGB. The loss is its MSE with the path-traced pixel, with L1 smoothness of albedo and roughness
over small steps, and squared differences of neighbouring pixels of an unknown light.
"""

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from formats.errors import QueryError
from formats.scene import Scene
from prt_bake.baselines.coarse_light import coarse_light
from prt_bake.baselines.nerfactor import NeRFactor
from prt_bake.baselines.nerfactor_views import View, cameras, light_pixels, path_traced_views
from prt_bake.lights.lighting import Lighting, as_lighting
from prt_bake.trainer.budget import Budget
from prt_bake.trainer.history import TrainingProgress
from prt_bake.trainer.run import Progress
from prt_bake.trainer.validation import Reference

_EXPOSED = 0.99
"""Share of the channels of all pixels that the exposure keeps below 1."""
_PICTURES_SHARE = 0.4
"""Share of the time at which the pictures are complete."""


@dataclass(frozen=True)
class PictureSettings:
    """The pictures and the loss; weights and rates are the published ones. Raises QueryError for values out of range.

    >>> from prt_bake.baselines.nerfactor_pictures import PictureSettings
    >>> PictureSettings(views=20).rays
    1024
    """

    views: int = 100
    size: int = 64
    """Width and height of a picture in pixels. The published 512 has no more to say about a mesh of known shape, and
    takes 64 times as long to path trace."""
    spp: int = 64
    """Most walks per pixel."""
    rays: int = 1024
    """Pixels of a step, all of one view."""
    epochs: int = 100
    """Steps of each view, unless the time ends them."""
    rate: float = 5e-3
    albedo_smoothness: float = 0.05
    roughness_smoothness: float = 0.01
    light_smoothness: float = 5e-6
    jitter: float = 0.01
    """Standard deviation of the steps over which smoothness is asked for, in half sides of the box."""
    report_every: float = 10.0
    held_out_queries: int = 512
    held_out_walks: int = 256

    def __post_init__(self) -> None:
        valid = {
            "views": (self.views >= 1, "1 or more"),
            "size": (self.size >= 4, "4 or more"),
            "spp": (self.spp >= 2, "2 or more"),
            "rays": (self.rays >= 1, "1 or more"),
            "epochs": (self.epochs >= 1, "1 or more"),
            "rate": (self.rate > 0.0, "a number above 0"),
        }
        for name, (fits, expected) in valid.items():
            if not fits:
                raise QueryError(f"picture settings: {name}: expected {expected}, found {getattr(self, name)!r}")


class PictureFit:
    """The views, the light and the optimiser of one training."""

    def __init__(
        self,
        model: NeRFactor,
        sky: ArrayLike | Lighting,
        light: Literal["unknown", "known"],
        settings: PictureSettings,
        seed: int,
    ) -> None:
        """Prepare; raises ImageError for a sky that is no picture, and QueryError for a black one."""
        self.model, self.settings, self.known, self._seed = model, settings, light == "known", seed
        up = str(model.metadata.get("up", "y"))
        self._lighting = as_lighting(sky, up, 0.0)
        small = coarse_light(self._lighting, up)
        if not small.any():
            raise QueryError("sky: expected light, found a black picture; give the sky of the pictures")
        self.pixels = light_pixels(small.shape[:2], up)
        self._angles = torch.from_numpy(self.pixels.solid_angles.astype(np.float32))
        self._true_light = torch.from_numpy(small)
        self._generator, self._numbers = torch.Generator().manual_seed(seed), np.random.default_rng(seed)
        self.light = torch.rand(small.shape, generator=self._generator).requires_grad_(not self.known)
        """Radiance [rows,columns,3] of the light, times the exposure."""
        parameters = [*model.parameters(), *([] if self.known else [self.light])]
        self._optimizer = torch.optim.Adam(parameters, lr=settings.rate, amsgrad=True)
        self.seconds, self.steps, self.walks = 0.0, 0, 0
        self._history: list[list[float]] = []

    def trace(self, scene: Scene, budget: Budget | None, follow: Callable[[float], None]) -> None:
        """Path trace the views; the last one is held out for the scale."""
        settings = self.settings
        eyes = cameras(scene, settings.views + 1, settings.size)
        eyes.append(eyes.pop(len(eyes) // 2))  # they are in order of height: a view from the side is held out

        def seconds(number: int) -> float | None:
            if budget is None:
                return None
            return max(0.01, (_PICTURES_SHARE * budget.total - budget.spent) / (len(eyes) - number))

        views, self.walks = path_traced_views(
            scene, self._lighting, self.model.lit, self.pixels, eyes, settings.spp, self._seed, seconds, follow
        )
        self.use(views[:-1], views[-1])

    def use(self, views: list[View], held_out: View) -> None:
        """Learn from these views, and fix the scale on another one."""
        self._views, self._held_out = [view for view in views if len(view.positions)], held_out
        if not self._views or not len(held_out.positions):
            raise QueryError("pictures: expected pixels on the object, found none; enlarge the pictures")
        brightest = float(np.quantile(np.concatenate([view.radiance for view in self._views]), _EXPOSED))
        if not brightest > 0.0:
            raise QueryError("pictures: expected light from the object, found black ones; give a brighter sky")
        self._exposure = 1.0 / brightest
        self._encoded = [self.model.encode_positions(torch.from_numpy(view.positions)) for view in self._views]
        exposed = [torch.from_numpy(self._exposure * view.radiance).float() for view in self._views]
        self._targets = [to_srgb(picture.clamp(0.0, 1.0)) for picture in exposed]
        if self.known:
            self.light = self._exposure * self._true_light

    def learn(
        self,
        steps: int | None,
        budget: Budget | None,
        reference: Reference,
        progress: Progress | None,
        stop: Callable[[], bool],
    ) -> bool:
        """Learn until the steps, the epochs or the time are over, and fix the scale; returns whether it was stopped."""
        most = steps or self.settings.epochs * len(self._views)
        length = math.inf if budget is None else budget.learning(0.0)
        begun = reported = time.perf_counter()
        losses: list[float] = []
        stopped, threads = False, torch.get_num_threads()
        if steps is not None:  # the rounding of sums depends on the number of threads
            torch.set_num_threads(1)
        try:
            while self.steps < most and self.seconds < length:
                if stop():
                    raise KeyboardInterrupt
                losses.append(self.step())
                now = time.perf_counter()
                self.seconds = now - begun
                if now - reported > self.settings.report_every:
                    share = max(self.steps / most, self.seconds / length)
                    self._report(share, losses, now - reported, reference, progress)
                    losses, reported = [], time.perf_counter()
        except KeyboardInterrupt:
            if self.steps == 0:
                raise
            stopped = True
        finally:
            torch.set_num_threads(threads)
        if losses and not stopped:
            self._report(1.0, losses, time.perf_counter() - reported, reference, progress)
        self.fix_scale()
        return stopped

    def step(self) -> float:
        """One step on pixels of one view; returns the loss."""
        turn = self.steps % len(self._views)
        if turn == 0:
            self._order = self._numbers.permutation(len(self._views))
        number = int(self._order[turn])
        view, encoded, targets = self._views[number], self._encoded[number], self._targets[number]
        rows = self._numbers.choice(len(targets), min(self.settings.rays, len(targets)), replace=False)
        diffuse, gloss = self._parts(encoded[rows], view.rays(rows, self.pixels), self.light)
        loss = nn.functional.mse_loss(to_srgb((diffuse + gloss).clamp(0.0, 1.0)), targets[rows])
        loss = loss + self._unevenness(encoded[rows])
        value = float(loss.detach())
        if not math.isfinite(value):
            raise QueryError(
                f"train: the loss of step {self.steps} is {value}; lower the rate ({self.settings.rate:g})"
            )
        self._optimizer.zero_grad(set_to_none=True)
        torch.autograd.backward(loss)
        self._optimizer.step()
        if not self.known:
            with torch.no_grad():
                self.light.clamp_(min=0.0)
        self.steps += 1
        return value

    def _parts(self, encoded: Tensor, rays: tuple[Tensor, Tensor, Tensor], light: Tensor) -> tuple[Tensor, Tensor]:
        """Radiance [n,3] of pixels by the diffuse and by the glossy part, under a light [rows,columns,3]."""
        flux, (cosines, _eye, _between) = light.reshape(-1, 3) * self._angles, rays
        diffuse = self.model.albedo(encoded) / np.pi * (cosines @ flux)
        if self.model.settings.reflectance == 0.0:
            return diffuse, torch.zeros_like(diffuse)
        return diffuse, self.model.lobe(encoded, *rays) @ flux

    def _unevenness(self, encoded: Tensor) -> Tensor:
        """The penalty of what is not smooth: albedo and roughness over the surface, and an unknown light."""
        settings, model = self.settings, self.model
        steps = settings.jitter * torch.randn(len(encoded), 3, generator=self._generator)
        beside = model.encode_relative(encoded[:, :3].double() + steps)
        total = settings.albedo_smoothness * (model.albedo(encoded) - model.albedo(beside)).abs().mean()
        if model.settings.reflectance > 0.0:
            difference = model.roughness_at(encoded) - model.roughness_at(beside)
            total = total + settings.roughness_smoothness * difference.abs().mean()
        if not self.known:
            across, down = (self.light - self.light.roll(1, dims=1)), self.light[1:] - self.light[:-1]
            total = total + settings.light_smoothness * ((across**2).sum() + (down**2).sum())
        return total

    def fix_scale(self) -> None:
        """Set the factor of the albedo, per channel, to that of least squares on the held-out view."""
        view, model = self._held_out, self.model
        with torch.no_grad():
            model.albedo_scale.fill_(1.0)
            encoded = model.encode_positions(torch.from_numpy(view.positions))
            parts = self._parts(encoded, view.rays(slice(None), self.pixels), self._true_light)
            diffuse, gloss = (part.double() for part in parts)
            rest = torch.from_numpy(view.radiance) - gloss
            scale = (diffuse * rest).sum(dim=0) / (diffuse**2).sum(dim=0).clamp(min=1e-30)
            model.albedo_scale.copy_(scale.clamp(min=0.0))

    def found_light(self) -> NDArray[np.float64]:
        """The light [rows,columns,3] in the unit of the sky, with the factor that the albedo's scale leaves it."""
        with torch.no_grad():
            scaled = self.light / self._exposure
            return np.asarray((scaled if self.known else scaled / self.model.albedo_scale.clamp(min=1e-30)).numpy())

    def description(self, quantity: str) -> dict[str, Any]:
        """Entries of the model's metadata: what it learned from, for how long, and the light."""
        return {
            "seconds": self.seconds,
            "steps": self.steps,
            "walks": self.walks,
            "seed": self._seed,
            "pictures": asdict(self.settings),
            "light_known": self.known,
            "light": self.found_light().tolist(),
            "albedo_scale": self.model.albedo_scale.tolist(),
            "precision": "float32",
            "device": "cpu",
            "validation_vs_time": self._history,
            "validation_of": quantity,
        }

    def _report(
        self, share: float, losses: list[float], seconds: float, reference: Reference, progress: Progress | None
    ) -> None:
        """Report the mean loss of the steps of the last `seconds`, with the scale as it would be now."""
        self.fix_scale()
        validation = reference.relative_rmse(self.model)
        with torch.no_grad():
            self.model.albedo_scale.fill_(1.0)
        self._history.append([self.seconds, self.walks, validation])
        if progress is not None:
            rows = self.settings.rays * len(losses) / max(seconds, 1e-9)
            loss = sum(losses) / len(losses)
            progress(TrainingProgress(self.seconds, self.steps, share, loss, validation, rows, 0.0, self.walks))


def to_srgb(linear: Tensor) -> Tensor:
    """sRGB values of linear ones from 0 to 1 (IEC 61966-2-1), with a gradient."""
    curved = 1.055 * linear.clamp(min=0.0031308) ** (1.0 / 2.4) - 0.055
    return torch.where(linear <= 0.0031308, 12.92 * linear, curved)
