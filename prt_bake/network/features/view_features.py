"""What the trunk of a network is told of a view: Fourier features averaged along the ray of view, and where it runs.

Light leaves towards ωo from wherever the ray of view was scattered inside, so what a query answers is the mean of
something smooth over the points p(s) of that ray, weighed by how likely the light comes from there:

    [cos, sin] of 2πG(p, ωo), averaged with the weights exp(−τ(s)) dτ, τ the optical depth along the ray.

Where the object is thin, or the ray leaves it and enters it again, the weights say so; features of x alone would have
to learn it point by point. The average is an integrated encoding (Barron et al. 2021, Mip-NeRF) with the medium's own
weights: over places that are equally likely, however thick or thin the medium. At an interface the ray is bent by the
normal, and turns at the boundary where it is totally reflected (`prt_bake.network.features.view_ray`); the normal and
the cosine are told, too, and where the places lie, the object's shape around some of them
(`prt_bake.network.features.shape`), and what has been learnt at them (`prt_bake.network.features.feature_grid`).
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from prt_bake.network.features.feature_grid import FeatureGrid
from prt_bake.network.features.interior import LEVELS, REACH, Interior
from prt_bake.network.features.light_ray import LightRay
from prt_bake.network.features.shape import SLOPE_SCALE, MAX_SLOPE, shape_grid, trilinear
from prt_bake.network.features.view_ray import Ray, folded, normals
from prt_bake.network.settings import COSINE_BUMPS, SHAPE_SCALES, SHAPE_INPUTS, LIGHT_RAY_ORIGINS, NetworkSettings

_MEAN_FREE_PATHS = 4.0
"""How far along the ray light is looked for, where the box is not smaller."""
_FARTHEST = 1.75
"""The diagonal of a cube, and a little."""
_FARTHEST_TURNED = 3.0
_INTERVALS, _INTERVALS_TURNED = 64, 128
_WARP = 3.0
"""How many times, in powers of e, the last interval is as long as the first: near the surface more depends on them."""
_OWN_SHARE = 0.25
"""Of the frequencies behind an interface, whose features are of x itself: what it reflects back inside takes other ways
than the ray of view."""
_USUAL_LENGTH = 0.4
"""Of a ray inside an object: in a thin medium opacities are told as multiples of what they are then."""
_LEAST_OPACITY = 1e-3
_WEIGHT = 3.0
"""Of normal and cosine among the other features, each of which has the mean square ½."""
_BUMP_WIDTH = 0.15
_LEAST_COSINE = 0.02
"""Of the outgoing direction where it is bent: grids tell normals roughly, and directions behind them have none."""


class ViewEncoding(NamedTuple):
    """What is told of views [N] whatever has been learnt, in float32.

    Attributes:
        features: [N,·].
        x: positions [N,3] in the box's sides from its corner.
        points, weight: the places [N,K,3] along the rays of view, and what the means over them weigh [N].
        axes: directions [N,A,3] whose cosines to ωi are told: the normal, and the slopes of the shape around x.
    """

    features: Tensor
    x: Tensor
    points: Tensor
    weight: Tensor
    axes: Tensor

    @property
    def frame(self) -> Tensor:
        """What is held against ωi [N,LIGHT_RAY_ORIGINS+A,3]: whence the way to the light is looked along, x and the middle one of
        the places, and then the axes.
        """
        return torch.cat((self.x[:, None], self.points[:, None, self.points.shape[1] // 2], self.axes), dim=1)


class ViewFeatures(nn.Module):
    """Features of positions and outgoing directions; on a CPU by `view_kernel`, unless `torch_only`."""

    frequencies: Tensor
    levels: Tensor
    corner: Tensor
    edges: Tensor
    shape: Tensor

    def __init__(self, settings: NetworkSettings, frequencies: Tensor, interior: Interior) -> None:
        """frequencies [F,6] of (x, ωo), the network's own."""
        super().__init__()
        self.torch_only = self.use_kernels = False
        self.interior, self._samples, self._normals = interior, settings.ray_samples, settings.tells_normal
        self._tells_exit = settings.lobes > 0
        apart = self._samples / max(settings.shape_places - 1, 1)
        self._shape_at = [int(apart * (place + 0.5)) for place in range(settings.shape_places - 1)]
        self._tells_shape, self._axes = settings.shape_places > 0, settings.light_axes
        self._turns = settings.ray_turns if settings.tells_normal else 0
        self._own = round(_OWN_SHARE * settings.features) if settings.tells_normal else 0
        self._gain = 1.0 / max(-math.expm1(-_USUAL_LENGTH * max(interior.attenuation)), _LEAST_OPACITY)
        for name, tensor in (
            ("frequencies", frequencies.detach().float()),
            ("levels", torch.from_numpy(interior.levels.astype("float32")) / LEVELS),
            ("corner", torch.tensor(interior.corner, dtype=torch.float32)),
            ("edges", interval_edges(interior, self._turns > 0)),
            ("shape", shape_grid(interior) if self._tells_shape else torch.empty(0)),
        ):
            self.register_buffer(name, tensor, persistent=False)
        self._reach = float(self.edges[-1])
        self.light = LightRay(interior, settings.light_places // len(LIGHT_RAY_ORIGINS)) if settings.light_places else None
        numbers = settings.grid_numbers
        self.grid = FeatureGrid(interior, settings.grid_places, numbers, self._reach) if settings.grid_places else None

    def forward(self, positions: Tensor, outgoing: Tensor, normals: Tensor | None = None) -> Tensor:
        """Features [N, settings.view_inputs] in float32: positions [N,3] in the box's sides from its corner, unit
        vectors outgoing [N,3]. Where normals [N,3] are zero, or not given, the grid's are taken.
        """
        return self.learnt(self.told(positions, outgoing, normals))

    def told(self, positions: Tensor, outgoing: Tensor, normals: Tensor | None = None) -> ViewEncoding:
        """What `learnt` takes, from what `forward` takes: the part that stays the same while the network learns."""
        x, eye = positions.float().contiguous(), outgoing.float().contiguous()
        with torch.no_grad(), torch.autocast(positions.device.type, enabled=False):
            return self._told(x, eye, normals)

    def learnt(self, told: ViewEncoding) -> Tensor:
        """The features [N, settings.view_inputs]: what has been learnt at the places, and what is told."""
        if self.grid is None:
            return told.features
        here, along = torch.ones((len(told.x), 1), device=told.x.device), told.weight[:, None] / self._samples
        places = along.expand(-1, self._samples)
        return torch.cat((self.grid(told.x[:, None], here), self.grid(told.points, places), told.features), dim=1)

    def towards(self, incident: Tensor, frame: Tensor) -> list[Tensor]:
        """What is told of views and directions of incidence [N,D,3] together, each [N,D,·]: what lies on the way, and
        the cosines to the axes; `frame` is that of `ViewEncoding`.
        """
        way = [] if self.light is None else [self.light(frame[:, : len(LIGHT_RAY_ORIGINS)], incident)]
        return [*way, incident @ frame[:, len(LIGHT_RAY_ORIGINS) :].transpose(1, 2)]

    def _told(self, x: Tensor, eye: Tensor, normals: Tensor | None) -> ViewEncoding:
        back, parts, axes = eye, [], torch.empty((len(x), 0, 3), device=x.device)
        if self._normals:
            normal = self._normal(x) if normals is None else self._known_or_found(normals.float(), x)
            cosine = (normal * eye).sum(-1, keepdim=True)
            back = _bent(eye, normal, cosine.clamp(min=_LEAST_COSINE), self.interior.eta)
            parts += [_WEIGHT * normal, _WEIGHT * _bumps(cosine)]
            axes = normal[:, None]
        ray = self._ray(x, back)
        places, opacity = self._places(self._depths(ray))
        points, weight = ray.points(places), self._gain * opacity
        parts += [places * (2.0 / self._reach), weight[:, None]]
        if self._tells_shape:
            parts.append(self._shape(torch.stack([x, *(points[:, at] for at in self._shape_at)], dim=1)))
            slopes = parts[-1][:, :SHAPE_INPUTS].reshape(len(x), len(SHAPE_SCALES), -1)[..., 1:]
            axes = torch.cat((axes, slopes / SLOPE_SCALE / MAX_SLOPE), dim=1)
        if self._tells_exit:
            parts.append(self._exit(ray))
        return ViewEncoding(
            torch.cat([self._averaged(x, eye, points, weight), *parts], dim=-1),
            x,
            points,
            weight,
            axes[:, : self._axes],
        )

    def _known_or_found(self, normals: Tensor, x: Tensor) -> Tensor:
        unknown = ~normals.any(dim=1)
        if x.device.type != "cpu":
            # A look at what is unknown would keep the card waiting.
            return torch.where(unknown[:, None], self._normal(x), normals)
        if bool(unknown.any()):
            normals = normals.clone()
            normals[unknown] = self._normal(x[unknown])
        return normals

    def _normal(self, x: Tensor) -> Tensor:
        """Normals [N,3] at positions by the object's grid."""
        return normals(lambda points: self._inside(0, points), self.interior.spacing, x)

    def _ray(self, x: Tensor, back: Tensor) -> Ray:
        """The rays of view from x [N,3] along −back [N,3]. Those that turn are followed by the processor, wherever x
        is, unless a card has a kernel for it: with tensors alone it takes thousands of small steps, each after a look
        at the one before.
        """
        if not self._turns:
            return Ray.straight(x, back)
        spacing, eta, longest = self.interior.spacing, self.interior.eta, self._reach
        if self.torch_only:
            return folded(lambda points: self._inside(0, points), spacing, eta, self._turns, longest, x, back)
        if self.use_kernels:
            from prt_bake.network.features.cuda_rays import trace_rays

            return trace_rays(self.levels[0], self.corner, spacing, eta, self._turns, longest, x, back)
        from prt_bake.network.features.view_kernel import trace_rows

        pieces = len(x), self._turns + 1
        starts, towards, begins = torch.empty((*pieces, 3)), torch.empty((*pieces, 3)), torch.empty(pieces)
        numbers = [np.float32(number) for number in (spacing, eta, longest)]
        known = (tensor.cpu() for tensor in (self.levels[0], x - self.corner, -back))
        told = [tensor.numpy() for tensor in (*known, starts, towards, begins)]
        trace_rows(told[0], numbers[0], numbers[1], numbers[2], told[1], told[2], told[3], told[4], told[5])
        return Ray(starts.to(x.device) + self.corner, towards.to(x.device), begins.to(x.device))

    def _exit(self, ray: Ray) -> Tensor:
        """Where rays go on to [N,3] once they have left the object, bent where they leave it first; a ray that is
        reflected there, or that never leaves, goes straight on.
        """
        inside = self._inside(0, ray.points(self.edges))
        within = inside > 0.0
        leaves = within[:, :-1] & ~within[:, 1:]
        first = leaves.to(torch.int8).argmax(dim=1, keepdim=True)
        before, after = inside.gather(1, first), inside.gather(1, first + 1)
        share = before / (before - after).clamp(min=1e-6)
        length = torch.lerp(self.edges[first], self.edges[first + 1], share.clamp(0.0, 1.0))
        point, ahead = ray.points(length)[:, 0], ray.along(length)[:, 0]
        normal = self._normal(point)
        return torch.where(leaves.any(dim=1, keepdim=True), _left(ahead, normal, self.interior.eta), ahead)

    def _depths(self, ray: Ray) -> Tensor:
        """Optical depths [N,M] of the intervals between edges along rays; a place belongs to the last body that it lies
        in.
        """
        points = ray.points(0.5 * (self.edges[1:] + self.edges[:-1]))
        attenuation = torch.zeros(points.shape[:2], device=points.device)
        for body, value in enumerate(self.interior.attenuation):
            within = (self._inside(body, points) * REACH + 0.5).clamp_(0.0, 1.0)
            attenuation.lerp_(torch.full_like(within, value), within)
        return attenuation * (self.edges[1:] - self.edges[:-1])

    def _inside(self, body: int, points: Tensor) -> Tensor:
        """Signed distances [N,K] to a body's boundary at points [N,K,3], over REACH spacings, in −1 … 1."""
        grid = self.levels[body]
        if self.torch_only or points.device.type != "cpu":
            return trilinear(grid[..., None], self.interior.spacing, points - self.corner)[..., 0]
        from prt_bake.network.features.view_kernel import distance_rows

        distances = torch.empty(points.shape[:2])
        per_length = np.float32(1.0 / self.interior.spacing)
        distance_rows(grid.numpy(), per_length, (points - self.corner).numpy(), distances.numpy())
        return distances

    def _shape(self, points: Tensor) -> Tensor:
        """What is told of the object around places [N,P,3]: [N,P·SHAPE_INPUTS]."""
        at = (points - self.corner).reshape(-1, 3)
        if self.torch_only or at.device.type != "cpu":
            return trilinear(self.shape, self.interior.spacing, at).reshape(len(points), -1)
        from prt_bake.network.features.view_kernel import shape_rows

        rows = torch.empty((len(at), SHAPE_INPUTS))
        shape_rows(self.shape.numpy(), np.float32(1.0 / self.interior.spacing), at.numpy(), rows.numpy())
        return rows.reshape(len(points), -1)

    def _places(self, depths: Tensor) -> tuple[Tensor, Tensor]:
        """Where light comes from along rays [N,K], all places equally likely, and the opacities [N] of the rays; zero
        where nothing is met.
        """
        if not self.torch_only and depths.device.type == "cpu":
            from prt_bake.network.features.view_kernel import place_rows

            places, opacity = torch.empty((len(depths), self._samples)), torch.empty(len(depths))
            place_rows(depths.numpy(), self.edges.numpy(), places.numpy(), opacity.numpy())
            return places, opacity
        reached = torch.cumsum(depths.double(), dim=1)
        reached = torch.cat((torch.zeros_like(reached[:, :1]), reached), dim=1)
        opacity = -torch.expm1(-reached[:, -1:])
        share = (torch.arange(self._samples, device=depths.device) + 0.5) / self._samples
        wanted = -torch.log1p(-share * opacity)
        after = torch.searchsorted(reached, wanted).clamp(1, depths.shape[1])
        low, high = reached.gather(1, after - 1), reached.gather(1, after)
        along = ((wanted - low) / (high - low).clamp(min=1e-30)).clamp(0.0, 1.0)
        places = torch.lerp(self.edges[after - 1].double(), self.edges[after].double(), along)
        return torch.where(opacity > 0.0, places, 0.0).float(), opacity[:, 0].float()

    def _averaged(self, x: Tensor, eye: Tensor, places: Tensor, weight: Tensor) -> Tensor:
        """[cosines, sines] [N,2F] of the phases: of the first frequencies at x itself, of the others averaged over
        places [N,K,3], times the weight.
        """
        own = self._own
        if not self.torch_only and x.device.type == "cpu":
            from prt_bake.network.features.view_kernel import mean_rows

            rows = torch.empty((len(x), 2 * len(self.frequencies)))
            told = [tensor.numpy() for tensor in (x, places.contiguous(), eye, weight)]
            cycles = self.frequencies.T.contiguous().numpy()
            mean_rows(told[0], told[1], told[2], told[3], cycles, own, rows.numpy())
            return rows
        toward_x, toward_eye = torch.split(2.0 * torch.pi * self.frequencies, 3, dim=1)
        of_eye = eye @ toward_eye.T
        here, there = x @ toward_x[:own].T + of_eye[:, :own], places @ toward_x[own:].T + of_eye[:, None, own:]
        return torch.cat(
            [
                torch.cat((part(here), part(there).mean(dim=1) * weight[:, None]), dim=-1)
                for part in (torch.cos, torch.sin)
            ],
            dim=-1,
        )


def _left(ahead: Tensor, normal: Tensor, eta: float) -> Tensor:
    """Where light that meets the boundary from inside along unit vectors `ahead` [N,3] goes on to, by Snell's law;
    straight on where it is totally reflected, or the normal is none.
    """
    cosine = (ahead * normal).sum(-1, keepdim=True)
    squared = 1.0 - eta**2 * (1.0 - cosine**2)
    bent = eta * ahead + (squared.clamp(min=0.0).sqrt() - eta * cosine) * normal
    leaves = (squared > 0.0) & (cosine > 0.0) & normal.any(dim=-1, keepdim=True)
    return nn.functional.normalize(torch.where(leaves, bent, ahead), dim=-1)


def interval_edges(interior: Interior, turned: bool) -> Tensor:
    """Between which the optical depth along a ray is summed up [M+1]: closer together near the surface, but evenly
    where light may come from bodies deep inside.
    """
    farthest = _FARTHEST_TURNED if turned else _FARTHEST
    share = torch.linspace(0.0, 1.0, (_INTERVALS_TURNED if turned else _INTERVALS) + 1, dtype=torch.float64)
    if len(interior.attenuation) > 1:
        return (farthest * share).float()
    reach = min(_MEAN_FREE_PATHS / max(interior.attenuation[0], 1e-9), farthest)
    return (reach * torch.expm1(_WARP * share) / math.expm1(_WARP)).float()


def _bumps(cosine: Tensor) -> Tensor:
    """Gaussians of the cosine's root [N,COSINE_BUMPS], close together where transmission falls fast."""
    centres = torch.linspace(0.0, 1.0, COSINE_BUMPS, device=cosine.device)
    return torch.exp(-(((cosine.clamp(0.0, 1.0).sqrt() - centres) / _BUMP_WIDTH) ** 2))


def _bent(eye: Tensor, normal: Tensor, cosine: Tensor, eta: float) -> Tensor:
    """Where light that leaves towards `eye` comes along inside [N,3], by Snell's law; unit vectors."""
    ratio = 1.0 / eta
    inner = (1.0 - ratio**2 * (1.0 - cosine**2)).clamp(min=0.0).sqrt()
    return nn.functional.normalize(ratio * eye + (inner - ratio * cosine) * normal, dim=-1)
