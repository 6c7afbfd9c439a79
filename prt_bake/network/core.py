"""The layers of the neural BSSRDF, as a torch module: Fourier features in, Ŝ [1/sr] out.

`NetworkCore` is all that `inference` needs to know of a network. `bssrdf.NeuralBSSRDF` adds the frozen forms to it.
"""

from collections.abc import Mapping
from copy import copy
from dataclasses import replace
from typing import Any, Literal, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from formats.arguments import described, numbers, real_number
from formats.errors import ModelError, QueryError, warn
from formats.mesh import Mesh, as_mesh
from prt_bake.geometry.surface import Surface
from prt_bake.network.features.fourier import encode_directions, fourier_features
from prt_bake.network.features.interior import Interior
from prt_bake.network.features.view_features import ViewEncoding, ViewFeatures
from prt_bake.network.features.view_path import Body, ViewPath, path_through
from prt_bake.network.initial_weights import initialise
from prt_bake.network.lobes import LOBE_PARAMETERS, Lobes, decode_lobes, evaluate_lobes
from prt_bake.network.low_bands import LOW_DEGREE, LowBands, correction_of, low_bands_of, low_harmonics, low_radiance
from prt_bake.network.model import NEURAL_BSSRDF, TrainableModel
from prt_bake.network.queries import float64_tensor, queries, refuse_outside
from prt_bake.network.settings import EXIT_INPUTS, NetworkSettings
from prt_bake.network.shared_inputs import linear_of_parts
from prt_bake.network.surface_check import OwnSurface

ROWS_PER_BATCH = 8192
_MAX_FLOAT32 = float(torch.finfo(torch.float32).max)
_LOBE_WEIGHT_SPREAD = 0.02
"""Standard deviation of the initial weights of lobes: small, so that all lobes start nearly alike, but not equal."""


class NetworkCore(TrainableModel):
    """A network for Ŝ(ωi; x, ωo) of one object; see `prt_bake.network.bssrdf` for its inputs."""

    kind = NEURAL_BSSRDF
    frequencies: Tensor
    light_frequencies: Tensor
    box_min: Tensor

    def __init__(
        self,
        settings: NetworkSettings | None = None,
        box_min: ArrayLike = (0.0, 0.0, 0.0),
        box_side: float = 1.0,
        output_scale: float = 1.0,
        metadata: dict[str, Any] | None = None,
        interior: Interior | None = None,
    ) -> None:
        """A freshly initialised network.

        box_min [3] and box_side (longest side) give the object's bounding box in scene units. output_scale [1/sr]
        multiplies the output of the last layer. metadata is plain JSON and is stored in the checkpoint. interior is for
        networks that average features along the view ray (settings.ray_samples > 0). The weights follow He et al. 2015;
        they and G depend only on settings.seed.

        Raises ModelError if the box or output_scale is not finite in float32, or if an interior is missing or not
        used.
        """
        super().__init__()
        if not isinstance(settings, NetworkSettings | None):
            raise QueryError(f"settings: expected NetworkSettings, found {described(settings)}")
        self.settings = settings or NetworkSettings()
        self.box_side = real_number("box_side", box_side)
        self.output_scale = real_number("output_scale", output_scale)
        if not isinstance(metadata, Mapping | None):
            raise QueryError(f"metadata: expected a dictionary, found {described(metadata)}")
        self.metadata: dict[str, Any] = dict(metadata or {})
        corner = torch.as_tensor(np.array(numbers("box_min", box_min), np.float64))
        scales = (self.box_side, self.output_scale)
        if (
            corner.shape != (3,)
            or not bool(corner.isfinite().all())
            or not all(0.0 < scale < _MAX_FLOAT32 for scale in scales)
        ):
            raise ModelError(
                f"network: box_min must be three finite numbers, box_side and output_scale positive and finite in "
                f"float32; found {corner.tolist()}, {self.box_side}, {self.output_scale}"
            )
        if (interior is None) != (self.settings.ray_samples == 0):
            raise ModelError(
                "network: an interior is needed if ray_samples is above 0, and only then; "
                f"found {'no' if interior is None else 'an'} interior and ray_samples {self.settings.ray_samples}"
            )
        if interior is not None and self.settings.interfaces and len(interior.inner) + 1 < len(interior.attenuation):
            raise ModelError(
                f"network: view rays are followed through {len(interior.attenuation)} bodies (interfaces is "
                f"{self.settings.interfaces}), which needs the meshes of those inside; found {len(interior.inner)}"
            )
        channels = 0 if interior is None else interior.channels
        if channels > self.settings.material_channels:
            raise ModelError(
                f"network: the interior has {channels} channels of a material, more than material_channels in the "
                f"settings, {self.settings.material_channels}"
            )
        self.settings = replace(self.settings, material_channels=channels)
        self._corner = corner.numpy()
        generator = torch.Generator().manual_seed(self.settings.seed)
        self._draw_frequencies(generator)
        self.register_buffer("box_min", corner, persistent=False)
        self.hidden = nn.ModuleList(nn.Linear(n, m) for m, n in self.settings.layer_shapes[:-1])
        self.output = nn.Linear(self.settings.width, 3)
        lobes = self.settings.lobes
        self.lobes = nn.Linear(self.settings.width, LOBE_PARAMETERS * lobes) if lobes else None
        self._initialise(generator)
        self.low = low_bands_of(self.settings, generator)
        self.correction = correction_of(self.settings, generator)
        self.surface: Surface | None = None
        """The object's mesh, which gives exact normals: see `on`."""
        self.path: ViewPath | None = None
        """Finds the paths of view rays in the meshes of a clear object: see `on`."""
        self._warned = [False]
        """Whether `warn_without_mesh` has warned, which copies share."""
        self.band: int | None = None
        """The degree up to which lobes are evaluated; None for all bands: see `smooth` and `up_to`."""
        self.only_low = False
        """Whether Ŝ is that of the low bands up to `band`: see `up_to`."""
        self.view = None if interior is None else ViewFeatures(self.settings, self.frequencies, interior)

    def _draw_frequencies(self, generator: torch.Generator) -> None:
        settings = self.settings
        spread = [settings.position_spread] * 3 + [settings.feature_spread] * settings.direction_inputs
        if not settings.trunk:
            spread = [settings.feature_spread] * settings.direction_inputs + spread
        deviation = torch.randn(settings.features, len(spread), generator=generator) * torch.tensor(spread)
        self.register_buffer("frequencies", settings.feature_mean + deviation)
        if settings.trunk:
            light = torch.randn(settings.light_features, settings.direction_inputs, generator=generator)
            self.register_buffer("light_frequencies", settings.light_spread * light)

    def _initialise(self, generator: torch.Generator) -> None:
        for layer in (*self.hidden, self.output):
            initialise(layer, 1.0 if layer is self.output else 2.0, generator)
        if self.lobes is not None:
            with torch.no_grad():
                self.lobes.weight.normal_(0.0, _LOBE_WEIGHT_SPREAD, generator=generator)
                self.lobes.bias.zero_()

    def forward(self, incident: Tensor, positions: Tensor, outgoing: Tensor) -> Tensor:
        """Ŝ [N,3] in 1/sr of unit vectors incident [N,3] and outgoing [N,3] at positions [N,3] in object space.

        Differentiable in the weights. Positions may be float64; they become relative to the box before they are
        rounded to float32. The layers run in the dtype of the weights (autocast works).
        """
        return self.radiance(incident[:, None], positions, outgoing)[:, 0]

    def radiance(self, incident: Tensor, positions: Tensor, outgoing: Tensor) -> Tensor:
        """Ŝ [N,D,3] in 1/sr, as `forward`, for D incident directions per query: incident [N,D,3]."""
        if self.only_low:
            low = self.low_coefficients(positions, outgoing)
            return low_radiance(low, low_harmonics(incident), self.band or 0) * self.output_scale
        smooth, lobes = self.components(incident, positions, outgoing)
        total = smooth if lobes is None else smooth.float() + evaluate_lobes(lobes, incident, self.band)
        return total * self.output_scale

    def components(
        self, incident: Tensor, positions: Tensor, outgoing: Tensor, encoding: ViewEncoding | None = None
    ) -> tuple[Tensor, Lobes | None]:
        """The two terms of Ŝ over the output scale: the layers' output [N,D,3], corrected, and the lobes to add to it.

        `encoding` is the result of `encode_views` for the same views, if it is already known.
        """
        lobes = correction = None
        activations: list[Tensor] = []
        trunk, dtype = self.settings.trunk, self.output.weight.dtype
        if trunk:
            if encoding is None:
                encoding = self.encode_views(positions, outgoing)
            features = self.view_features(positions, outgoing, encoding)
            activations = self.trunk_outputs(features[:, None].to(dtype))
            h = activations[-1]
            if self.lobes is not None:
                lobes = decode_lobes(self.lobes(h)[:, 0], features[:, -EXIT_INPUTS:])
            if self.correction is not None:
                correction = self.correction(torch.cat((features, h[:, 0].float()), dim=-1))
            pairs = self.pair_features(incident, outgoing, None if encoding is None else encoding.frame)
            light = torch.cat((self.light_features(incident), pairs), dim=-1).to(dtype)
        else:
            shape = incident.shape
            u = self.inputs(incident, positions[:, None].expand(shape), outgoing[:, None].expand(shape))
            h = self._fourier_features(u).to(dtype)
        for number in range(trunk + 1, self.settings.layers + 1):
            h = self._layer(number, h, activations, [light] if trunk else [])
            activations.append(h)
        if correction is None:
            return self.output(h), lobes
        return self.output(h).float() + low_radiance(correction, low_harmonics(incident), LOW_DEGREE), lobes

    def trunk_outputs(self, h: Tensor) -> list[Tensor]:
        """Outputs [N,1,width] of the layers that do not see ωi, from the inputs [N,1,view_inputs] of the first."""
        outputs: list[Tensor] = []
        for number in range(1, self.settings.trunk + 1):
            h = self._layer(number, h, outputs, [])
            outputs.append(h)
        return outputs

    def _layer(self, number: int, h: Tensor, outputs: list[Tensor], more: list[Tensor]) -> Tensor:
        """The output of hidden layer `number`, from that of the layer before, those of its skips, and more inputs."""
        skips = (outputs[source - 1] for source in self.settings.sources(number))
        h = linear_of_parts(self.hidden[number - 1], [h, *skips, *more])
        return torch.relu(h) if self.settings.activation == "relu" else torch.nn.functional.silu(h)

    def low_coefficients(self, positions: Tensor, outgoing: Tensor) -> Tensor:
        """a_lm [N,9,3] to degree 2 over the output scale, of networks with low bands."""
        assert self.low is not None
        return self.low.forward(self.view_features(positions, outgoing))

    def view_features(self, positions: Tensor, outgoing: Tensor, encoding: ViewEncoding | None = None) -> Tensor:
        """Inputs of the first layer [N, settings.view_inputs] in float32, for a network whose late layers see ωi."""
        if self.view is None:
            return self._fourier_features(self.inputs(None, positions, outgoing))
        if encoding is None:
            encoding = self.encode_views(positions, outgoing)
        assert encoding is not None
        return self.view.features(encoding)

    def encode_views(self, positions: Tensor, outgoing: Tensor) -> ViewEncoding | None:
        """The part of `view_features` that does not depend on the weights; None for networks without an interior."""
        if self.view is None:
            return None
        normals = self.mesh_normals(positions, outgoing)
        return self.view.encode(self.relative_positions(positions), outgoing, normals, self.path)

    def refuse_foreign(self, mesh: Mesh) -> None:
        """Raise QueryError if most vertices of the mesh are off the surface that the network was trained on, and warn
        if some are. A network without an interior does not know its surface.
        """
        if self.view is not None:
            OwnSurface(self.view.interior, self.box_min.cpu().numpy(), self.box_side).refuse_foreign(mesh)

    def on(self, mesh: Mesh) -> Self:
        """The same network, weights shared, that takes its normals from the object's mesh.

        In a clear object it follows view rays through the mesh, too. Without a mesh the normals come from a coarse
        grid, which rounds edges off, and view rays are straight: the first evaluation warns. A position on an edge
        belongs to the face that faces ωo most (`prt_bake.geometry.surface`). A network without normals is returned
        unchanged.
        """
        mesh = as_mesh("mesh", mesh)
        if not self.settings.tells_normal or (self.surface is not None and self.surface.mesh is mesh):
            return self
        bound = copy(self)
        bound.surface = Surface(mesh)
        bound.path = self._path_in(mesh)
        return bound

    def _path_in(self, mesh: Mesh) -> ViewPath | None:
        """Finds the paths of view rays in the object's mesh; None if they are straight."""
        if self.view is None or not self.settings.interfaces:
            return None
        positions, faces = (mesh.positions - self._corner) / self.box_side, np.asarray(mesh.faces, np.int64)
        corners = mesh.normals[faces] if self._normals_of_vertices else None
        return path_through(Body(positions, faces, corners), self.view.interior, self.settings)

    def up_to(self, degree: int) -> Self:
        """The same network, weights shared, for the bands up to `degree` alone.

        With low bands, and up to degree 2, it is Σ a_lm Y_lm(ωi), exact in few directions; otherwise it is `smooth`.
        """
        if self.low is None or degree > LOW_DEGREE:
            return self.smooth(degree)
        limited = copy(self)
        limited.band, limited.only_low = degree, True
        return limited

    def smooth(self, degree: int) -> Self:
        """The same network, weights shared, with its lobes limited to the bands up to `degree`.

        A few directions may all miss a narrow lobe. They integrate its bands exactly. A network without lobes is
        returned unchanged.
        """
        if self.lobes is None and not self.only_low:
            return self
        limited = copy(self)
        limited.band, limited.only_low = degree, False
        return limited

    def set_low_bands(self, low: LowBands | None) -> None:
        """Take other low bands; without any, the coefficients to degree 2 are those of Ŝ."""
        self.low, self.correction = low, None
        width, layers = (0, self.settings.low_layers) if low is None else (low.output.in_features, len(low.hidden))
        self.settings = replace(self.settings, low_width=width, low_layers=layers, correction_width=0)

    def set_correction(self, correction: LowBands) -> None:
        """Take layers that correct the values."""
        self.correction = correction
        self.settings = replace(self.settings, correction_width=correction.output.in_features)

    def warn_without_mesh(self) -> None:
        """Warn, once per network, if normals are an input and no mesh gives them."""
        if self.settings.tells_normal and self.surface is None and not self._warned[0]:
            self._warned[0] = True
            warn(
                "network: it takes normals as input and has no mesh to take them from; those of a coarse grid, and "
                "straight view rays in clear objects, can double its error; use network.on(mesh), or "
                "prt.load_model(path, mesh=mesh)"
            )

    @property
    def _normals_of_vertices(self) -> bool:
        return self.metadata.get("normals") == "vertex"

    def mesh_normals(self, positions: Tensor, outgoing: Tensor) -> Tensor | None:
        """Unit normals [N,3] of the mesh that `on` was given; None without one."""
        if self.surface is None:
            self.warn_without_mesh()
            return None
        kind: Literal["face", "vertex"] = "vertex" if self._normals_of_vertices else "face"
        x, eye = (tensor.detach().double().cpu().numpy() for tensor in (positions, outgoing))
        return torch.from_numpy(self.surface.normals(x, eye, kind)).to(positions.device)

    def packed_paths(self, positions: Tensor, outgoing: Tensor, normals: Tensor) -> Tensor:
        """The paths of views, found by the processor: `PathSamples.packed`; [N,0] if they are straight."""
        if self.view is None or self.path is None:
            return positions[:, :0]
        x = (positions.double() - torch.from_numpy(self._corner).to(positions.device)) / self.box_side
        return self.path(x.float(), self.view.back(outgoing.float(), normals.float())).packed().to(positions.dtype)

    def light_features(self, incident: Tensor) -> Tensor:
        """Fourier features [..., 2·light_features] in float32 of directions that only the late layers see."""
        return fourier_features(encode_directions(incident, self.settings.directions), self.light_frequencies)

    def pair_features(self, incident: Tensor, outgoing: Tensor, frame: Tensor | None) -> Tensor:
        """Features [N,D,settings.pair_inputs] in float32 of views and incident directions together.

        They are (ωi·ωo)ⁿ from n = 1, occupancy along the light rays, and cosines of ωi to the view's axes. incident
        [N,D,3], outgoing [N,3]; `frame` is `ViewEncoding.frame`.
        """
        with torch.autocast(incident.device.type, enabled=False):
            cosine = incident.float() @ outgoing.float()[..., None]
            parts = [cosine**power for power in range(1, self.settings.angle_powers + 1)]
            if self.view is not None and frame is not None:
                parts += self.view.light_features(incident.float(), frame)
        return torch.cat((cosine[..., :0], *parts), dim=-1)

    def inputs(self, incident: Tensor | None, positions: Tensor, outgoing: Tensor) -> Tensor:
        """The inputs u [N,·] in float64: ωi (unless only late layers see it), x and ωo, encoded."""
        form = self.settings.directions
        parts = [] if incident is None else [encode_directions(incident, form)]
        return torch.cat((*parts, self.relative_positions(positions), encode_directions(outgoing, form)), dim=-1)

    def relative_positions(self, positions: Tensor) -> Tensor:
        """Object-space positions [...,3] as (x − box_min) / box_side, in float64."""
        return (positions.double() - self.box_min) / self.box_side

    def _fourier_features(self, u: Tensor) -> Tensor:
        return fourier_features(u, self.frequencies, self.settings.feature_mean)

    def evaluate(self, incident: ArrayLike, positions: ArrayLike, outgoing: ArrayLike) -> NDArray[np.float32]:
        """Ŝ [N,D,3] in 1/sr, float32: incident [D,3] shared by all queries or [N,D,3], positions [N,3], outgoing [N,3].

        Runs `radiance` in batches, and is the reference for `evaluate_block`.
        """
        light, x, eye = queries(incident, positions, outgoing, self.frequencies.device)
        if self.surface is not None:
            refuse_outside(x, self.box_min, self.box_side)
        count = x.shape[0]
        light = light.expand(count, *light.shape[-2:]) if light.ndim == 2 else light
        directions = light.shape[1]
        result = np.empty((count, directions, 3), dtype=np.float32)
        columns = max(1, min(directions, ROWS_PER_BATCH))
        at_once = max(1, ROWS_PER_BATCH // max(1, columns))
        with torch.inference_mode():
            for n in range(0, count, at_once):
                rows = slice(n, n + at_once)
                for d in range(0, directions, columns):
                    radiance = self.radiance(light[rows, d : d + columns], x[rows], eye[rows])
                    result[rows, d : d + columns] = radiance.float().cpu().numpy()
        return result

    def own_lobes(
        self, positions: ArrayLike, outgoing: ArrayLike
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]] | None:
        """The lobes at positions [N,3] seen along outgoing [N,3]: axes [N,J,3], sharpness [N,J] and their integrals
        over the sphere [N,J,3]; None for a network without lobes. `up_to` gives the network without them.
        """
        if self.lobes is None:
            return None
        device = self.frequencies.device
        x, eye = (float64_tensor(vectors, device) for vectors in (positions, outgoing))
        parts = []
        with torch.inference_mode():
            for n in range(0, len(x), ROWS_PER_BATCH):
                rows = slice(n, n + ROWS_PER_BATCH)
                parts.append(self.components(eye[rows, None], x[rows], eye[rows])[1])
        axes, sharpness, peaks = (torch.cat(part).double().cpu().numpy() for part in zip(*parts, strict=True))
        integrals = 2.0 * np.pi * -np.expm1(-2.0 * sharpness) / sharpness
        return axes, sharpness, peaks * self.output_scale * integrals[..., None]
