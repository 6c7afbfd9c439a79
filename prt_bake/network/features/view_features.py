"""Inputs of the trunk for a view: Fourier features averaged along the view ray, and what the ray meets.

Light leaves towards ωo from the points of the view ray where it was scattered last. A query is therefore the mean of a
smooth function over the points p(s) of that ray, weighted by the probability that light comes from there:

    [cos, sin] of 2πG(p, ωo), averaged with weights exp(−τ(s)) dτ, τ the optical depth along the ray.

Where the object is thin, or the ray leaves it and enters it again, the weights encode this; from features of x alone it
would have to be learned point by point. The average is an integrated encoding (Barron et al. 2021, Mip-NeRF) with the
medium's weights: over equally probable points, whatever the density of the medium.

At an interface the ray is refracted by the normal. In a clear object it is followed through the interfaces that it
meets (`view_path`). The normal and its cosine to ωo are inputs, too, and so are the distances of the points, the
object's shape around some of them (`shape`), and features that are learned at them (`feature_grid`).
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from prt_bake.network.features.feature_grid import FeatureGrid, kept_places
from prt_bake.network.features.interior import LEVELS, REACH, Interior
from prt_bake.network.features.light_ray import LightRay
from prt_bake.network.features.material import material_grid
from prt_bake.network.features.refraction import normals, refracted_in, refracted_out
from prt_bake.network.features.shape import MAX_SLOPE, SLOPE_SCALE, shape_grid, trilinear
from prt_bake.network.features.view_path import PathSamples, PathTracer
from prt_bake.network.settings import (
    AXIS_LENGTH,
    COSINE_BUMPS,
    LIGHT_RAY_ORIGINS,
    SHAPE_INPUTS,
    SHAPE_SCALES,
    NetworkSettings,
)

_MEAN_FREE_PATHS = 4.0
"""Length of the view ray, if the object is larger."""
_MAX_LENGTH, _MAX_LENGTH_CLEAR = 1.75, 3.0
"""Maximum length of straight rays in box sides, a little more than the diagonal of a cube; in clear objects that of
straight rays where no mesh is known, and the unit in which lengths of paths are inputs."""
_INTERVALS, _INTERVALS_CLEAR = 64, 128
_WARP = 3.0
"""Logarithm of the ratio of the last interval to the first: more depends on points near the surface."""
_UNAVERAGED_SHARE = 0.25
"""Share of the frequencies behind an interface whose features are those of x itself: light that the interface reflects
back inside takes other paths than the view ray."""
_TYPICAL_LENGTH = 0.4
"""Typical length of a ray inside an object: opacities are inputs relative to that of this length."""
_MIN_OPACITY = 1e-3
_BUMP_WIDTH = 0.15
_MIN_COSINE = 0.02
"""Minimum cosine of ωo at refraction: normals of grids are coarse, and directions behind them have no refraction."""


class ViewEncoding(NamedTuple):
    """The part of the view features [N] that does not depend on learned weights, in float32.

    Attributes:
        features: inputs of the trunk [N,·], without those of the learned grid.
        x: positions [N,3] in box sides from the box's corner.
        points, weight: points [N,K,3] along the view rays, and the weight [N] of means over them.
        axes: directions [N,A,3] whose cosines to ωi are inputs: the normal, and the slopes of the shape around x, and
            at the middle of the view ray in an object with bodies inside.
    """

    features: Tensor
    x: Tensor
    points: Tensor
    weight: Tensor
    axes: Tensor

    @property
    def frame(self) -> Tensor:
        """The vectors [N,LIGHT_RAY_ORIGINS+A,3] that are combined with ωi: origins of light rays, then the axes.

        The origins are x and the middle one of the points.
        """
        return torch.cat((self.x[:, None], self.points[:, None, self.points.shape[1] // 2], self.axes), dim=1)


class ViewFeatures(nn.Module):
    """Features of positions and outgoing directions; compiled (`view_kernel`) on the CPU unless `torch_only` is set."""

    frequencies: Tensor
    levels: Tensor
    corner: Tensor
    edges: Tensor
    shape: Tensor
    material: Tensor

    def __init__(self, settings: NetworkSettings, frequencies: Tensor, interior: Interior) -> None:
        """`frequencies` [F,6] of (x, ωo) are the network's."""
        super().__init__()
        self.torch_only = False
        self.interior, self._samples, self._has_normal = interior, settings.ray_samples, settings.tells_normal
        self._has_exit, self._has_shape = settings.lobes > 0, settings.shape_places > 0
        self._has_directions, self._parts = settings.low_axes, settings.material_parts
        spacing = self._samples / max(settings.shape_places - 1, 1)
        self._shape_at = [int(spacing * (place + 0.5)) for place in range(settings.shape_places - 1)]
        self._axes, self._sloped = settings.light_axes, settings.sloped_places
        self._unaveraged = round(_UNAVERAGED_SHARE * settings.features) if settings.tells_normal else 0
        self._gain = 1.0 / max(-math.expm1(-_TYPICAL_LENGTH * max(interior.attenuation)), _MIN_OPACITY)
        for name, tensor in (
            ("frequencies", frequencies.detach().float()),
            ("levels", torch.from_numpy(interior.levels.astype("float32")) / LEVELS),
            ("corner", torch.tensor(interior.corner, dtype=torch.float32)),
            ("edges", interval_edges(interior, settings.interfaces > 0)),
            ("shape", shape_grid(interior, settings.inner_bodies) if self._has_shape else torch.empty(0)),
        ):
            self.register_buffer(name, tensor, persistent=False)
        self._length = float(self.edges[-1])
        self.register_buffer("material", self._material_grid(), persistent=False)
        places = settings.light_places // len(LIGHT_RAY_ORIGINS)
        self.light = LightRay(interior, places, settings.inner_bodies) if places else None
        self.grid: FeatureGrid | None = None
        if settings.grid_places:
            self.grid = FeatureGrid(interior, settings.grid_places, settings.grid_numbers, self._length)

    def forward(self, positions: Tensor, outgoing: Tensor, normals: Tensor | None = None) -> Tensor:
        """Features [N, settings.view_inputs] in float32 of unit vectors outgoing [N,3] at positions [N,3].

        Positions are in box sides from the box's corner. Normals [N,3] that are 0 or not given come from the grid.
        """
        return self.features(self.encode(positions, outgoing, normals))

    def encode(
        self, positions: Tensor, outgoing: Tensor, normals: Tensor | None = None, path: PathTracer | None = None
    ) -> ViewEncoding:
        """The part of `forward` that does not depend on learned weights.

        `path` finds the paths of the views in the object's meshes; without it they are straight.
        """
        x, eye = positions.float().contiguous(), outgoing.float().contiguous()
        with torch.no_grad(), torch.autocast(positions.device.type, enabled=False):
            return self._encode(x, eye, normals, path)

    def features(self, encoding: ViewEncoding) -> Tensor:
        """The features [N, settings.view_inputs]: learned features at x and along the ray, then the encoding's."""
        if self.grid is None:
            return encoding.features
        once = torch.ones((len(encoding.x), 1), device=encoding.x.device)
        weights = (encoding.weight[:, None] / self._samples).expand(-1, self._samples)
        at_x, along = self.grid(encoding.x[:, None], once), self.grid(encoding.points, weights)
        return torch.cat((at_x, along, encoding.features), dim=1)

    def light_features(self, incident: Tensor, frame: Tensor) -> list[Tensor]:
        """Features of views and incident directions [N,D,3] together, each [N,D,·]; `frame` is the encoding's.

        They are the occupancy along the light rays, and the cosines to the axes.
        """
        origins = len(LIGHT_RAY_ORIGINS)
        occupancy = [] if self.light is None else [self.light(frame[:, :origins], incident)]
        return [*occupancy, incident @ frame[:, origins:].transpose(1, 2)]

    def _encode(self, x: Tensor, eye: Tensor, normals: Tensor | None, path: PathTracer | None) -> ViewEncoding:
        back, parts, axes = eye, [], torch.empty((len(x), 0, 3), device=x.device)
        if self._has_normal:
            normal = self._normal(x) if normals is None else self._completed(normals.float(), x)
            back = self.back(eye, normal)
            parts += [AXIS_LENGTH * normal, AXIS_LENGTH * _bumps((normal * eye).sum(-1, keepdim=True))]
            axes = normal[:, None]
        lengths, points, opacity, leaving = (path or self._straight)(x, back)
        weight = self._gain * opacity
        parts += [lengths * (2.0 / self._length), weight[:, None]]
        if self._has_shape:
            shape = self._shape(torch.stack([x, *(points[:, at] for at in self._shape_at)], dim=1))
            by_place = shape.reshape(len(x), -1, len(SHAPE_SCALES), SHAPE_INPUTS // len(SHAPE_SCALES))
            slopes = [by_place[:, place, :, 1:] / SLOPE_SCALE / MAX_SLOPE for place in self._sloped]
            axes = torch.cat((axes, *slopes), dim=1)
            parts.append(shape)
        if self._has_directions:
            parts += [AXIS_LENGTH * eye, AXIS_LENGTH * back]
        if self.interior.material is not None:
            parts += self._material(x, points)
        if self._has_exit:
            parts.append(leaving)
        features = torch.cat([self._averaged(x, eye, points, weight), *parts], dim=-1)
        return ViewEncoding(features, x, points, weight, axes[:, : self._axes])

    def back(self, eye: Tensor, normal: Tensor) -> Tensor:
        """Directions [N,3] inside towards the surface, of light that leaves along `eye` [N,3]."""
        cosine = (normal * eye).sum(-1, keepdim=True).clamp(min=_MIN_COSINE)
        return refracted_in(eye, normal, cosine, self.interior.eta)

    def _completed(self, normals: Tensor, x: Tensor) -> Tensor:
        """The normals [N,3], with those of the grid where they are 0."""
        missing = ~normals.any(dim=1)
        if x.device.type != "cpu":
            # On a GPU a check of what is missing would wait for the device.
            return torch.where(missing[:, None], self._normal(x), normals)
        if bool(missing.any()):
            normals = normals.clone()
            normals[missing] = self._normal(x[missing])
        return normals

    def _normal(self, x: Tensor) -> Tensor:
        """Normals [N,3] of the object's grid at positions."""
        return normals(lambda points: self._inside(0, points), self.interior.spacing, x)

    def _straight(self, x: Tensor, back: Tensor) -> PathSamples:
        """The paths of view rays from x [N,3] along −back [N,3], straight, in the grids."""
        lengths, opacity = self._samples_along(self._depths(x, back))
        leaving = self._leaving(x, back) if self._has_exit else -back
        return PathSamples(lengths, _points(x, back, lengths), opacity, leaving)

    def _leaving(self, x: Tensor, back: Tensor) -> Tensor:
        """Directions [N,3] of straight rays after they have left the object, refracted where they leave it first.

        A ray that is totally reflected there, or that never leaves, goes straight on.
        """
        inside = self._inside(0, _points(x, back, self.edges))
        within = inside > 0.0
        leaves = within[:, :-1] & ~within[:, 1:]
        first = leaves.to(torch.int8).argmax(dim=1, keepdim=True)
        before, after = inside.gather(1, first), inside.gather(1, first + 1)
        share = before / (before - after).clamp(min=1e-6)
        length = torch.lerp(self.edges[first], self.edges[first + 1], share.clamp(0.0, 1.0))
        refracted = refracted_out(-back, self._normal(_points(x, back, length)[:, 0]), self.interior.eta)
        return torch.where(leaves.any(dim=1, keepdim=True), refracted, -back)

    def _depths(self, x: Tensor, back: Tensor) -> Tensor:
        """Optical depths [N,M] of intervals along straight rays; a point belongs to the last body that contains it."""
        points = _points(x, back, 0.5 * (self.edges[1:] + self.edges[:-1]))
        attenuation = torch.zeros(points.shape[:2], device=points.device)
        for body, value in enumerate(self.interior.attenuation):
            within = (self._inside(body, points) * REACH + 0.5).clamp_(0.0, 1.0)
            attenuation.lerp_(torch.full_like(within, value), within)
        return attenuation * (self.edges[1:] - self.edges[:-1])

    def _inside(self, body: int, points: Tensor) -> Tensor:
        """Signed distances [N,K] of points [N,K,3] to a body's boundary, over REACH spacings, in −1 … 1."""
        grid = self.levels[body]
        if self.torch_only or points.device.type != "cpu":
            return trilinear(grid[..., None], self.interior.spacing, points - self.corner)[..., 0]
        from prt_bake.network.features.view_kernel import distance_rows

        distances = torch.empty(points.shape[:2])
        per_length = np.float32(1.0 / self.interior.spacing)
        distance_rows(grid.numpy(), per_length, (points - self.corner).numpy(), distances.numpy())
        return distances

    def _shape(self, points: Tensor) -> Tensor:
        """The shape features [N,P·SHAPE_INPUTS] of points [N,P,3]."""
        return self._values(self.shape, self.interior.spacing, points).flatten(1)

    def _material_grid(self) -> Tensor:
        """The grid of `material_grid`; empty without a material."""
        material = self.interior.material
        if material is None:
            return torch.empty(0)
        return material_grid(material, kept_places(self.interior, material.per_side, self._length))

    def _material(self, x: Tensor, points: Tensor) -> list[Tensor]:
        """The material's values at x [N,3] and their means over points [N,K,3] and over parts of them, each [N,·]."""
        assert self.interior.material is not None
        at = torch.cat((x[:, None], points), dim=1)
        values = self._values(self.material, 1.0 / self.interior.material.per_side, at)
        along = values[:, 1:]
        inputs = [values[:, 0], along.mean(dim=1)]
        if self._parts:
            unblurred = along[..., : self.interior.channels]
            inputs += [part.mean(dim=1) for part in torch.split(unblurred, self._samples // self._parts, dim=1)]
        return inputs

    def _values(self, grid: Tensor, spacing: float, points: Tensor) -> Tensor:
        """Trilinear values [...,C] of a grid [X,Y,Z,C] at points [...,3]."""
        at = (points - self.corner).reshape(-1, 3)
        if self.torch_only or at.device.type != "cpu":
            values = trilinear(grid, spacing, at)
        else:
            from prt_bake.network.features.view_kernel import shape_rows

            values = torch.empty((len(at), grid.shape[3]))
            shape_rows(grid.numpy(), np.float32(1.0 / spacing), at.numpy(), values.numpy())
        return values.reshape(*points.shape[:-1], -1)

    def _samples_along(self, depths: Tensor) -> tuple[Tensor, Tensor]:
        """Lengths [N,K] along rays from where light comes, equally probable, and the opacities [N] of the rays.

        Both are 0 for rays that meet nothing. depths [N,M] are the optical depths of the intervals.
        """
        if not self.torch_only and depths.device.type == "cpu":
            from prt_bake.network.features.view_kernel import sample_rows

            lengths, opacity = torch.empty((len(depths), self._samples)), torch.empty(len(depths))
            sample_rows(depths.numpy(), self.edges.numpy(), lengths.numpy(), opacity.numpy())
            return lengths, opacity
        total = torch.cumsum(depths.double(), dim=1)
        total = torch.cat((torch.zeros_like(total[:, :1]), total), dim=1)
        opacity = -torch.expm1(-total[:, -1:])
        share = (torch.arange(self._samples, device=depths.device) + 0.5) / self._samples
        target = -torch.log1p(-share * opacity)
        after = torch.searchsorted(total, target).clamp(1, depths.shape[1])
        low, high = total.gather(1, after - 1), total.gather(1, after)
        within = ((target - low) / (high - low).clamp(min=1e-30)).clamp(0.0, 1.0)
        lengths = torch.lerp(self.edges[after - 1].double(), self.edges[after].double(), within)
        return torch.where(opacity > 0.0, lengths, 0.0).float(), opacity[:, 0].float()

    def _averaged(self, x: Tensor, eye: Tensor, points: Tensor, weight: Tensor) -> Tensor:
        """Fourier features [N,2F]: of x for the first frequencies, for the others averaged over points [N,K,3].

        Averages are multiplied by weight [N].
        """
        first = self._unaveraged
        if not self.torch_only and x.device.type == "cpu":
            from prt_bake.network.features.view_kernel import mean_rows

            rows = torch.empty((len(x), 2 * len(self.frequencies)))
            frequencies = self.frequencies.T.contiguous().numpy()
            along = points.contiguous().numpy()
            mean_rows(x.numpy(), along, eye.numpy(), weight.numpy(), frequencies, first, rows.numpy())
            return rows
        of_x, of_eye = torch.split(2.0 * torch.pi * self.frequencies, 3, dim=1)
        eye_phase = eye @ of_eye.T
        at_x = x @ of_x[:first].T + eye_phase[:, :first]
        at_points = points @ of_x[first:].T + eye_phase[:, None, first:]
        return torch.cat(
            [
                torch.cat((function(at_x), function(at_points).mean(dim=1) * weight[:, None]), dim=-1)
                for function in (torch.cos, torch.sin)
            ],
            dim=-1,
        )


def interval_edges(interior: Interior, clear: bool) -> Tensor:
    """Edges [M+1] of the intervals along a ray over which the optical depth is summed, in box sides.

    Intervals are shorter near the surface, but equal if there are other bodies inside, from which light may come.
    """
    longest = _MAX_LENGTH_CLEAR if clear else _MAX_LENGTH
    count = _INTERVALS_CLEAR if clear else _INTERVALS
    share = torch.linspace(0.0, 1.0, count + 1, dtype=torch.float64)
    if len(interior.attenuation) > 1:
        return (longest * share).float()
    length = min(_MEAN_FREE_PATHS / max(interior.attenuation[0], 1e-9), longest)
    return (length * torch.expm1(_WARP * share) / math.expm1(_WARP)).float()


def _points(x: Tensor, back: Tensor, lengths: Tensor) -> Tensor:
    """Points [N,K,3] of straight rays from x [N,3] along −back [N,3] after lengths [N,K], or [K] for all rays."""
    return x[:, None] - lengths[..., None] * back[:, None]


def _bumps(cosine: Tensor) -> Tensor:
    """Gaussians of the square root of the cosine [N,COSINE_BUMPS]: dense where transmission falls fast."""
    centres = torch.linspace(0.0, 1.0, COSINE_BUMPS, device=cosine.device)
    return torch.exp(-(((cosine.clamp(0.0, 1.0).sqrt() - centres) / _BUMP_WIDTH) ** 2))
