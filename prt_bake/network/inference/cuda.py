"""A frozen network on a GPU: one Triton kernel from the rows of a block to RGB, and view features as one CUDA graph.

A bake evaluates small blocks (a few hundred views). Launching hundreds of operations of a few microseconds each would
take longer than the operations. Here all views of a batch are one graph launch, and all their rows are one kernel
launch (`cuda_kernels`); the processor finds normals and the paths of view rays before. Results are copied to
page-locked memory while later ones are computed, because the copy takes longer than the computation.
"""

import warnings
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from prt_bake.network.core import NetworkCore
from prt_bake.network.features.view_path import known_paths
from prt_bake.network.inference.cuda_views import MIN_TILE, PairColumns, RecordedGraph, ViewTerms, stream
from prt_bake.network.inference.fused import FusedNetwork
from prt_bake.network.inference.light_tables import LightTable, table_bounds
from prt_bake.network.lobes import Bands, Lobes, lobe_bands
from prt_bake.network.low_bands import LOW_DEGREE, low_harmonics, low_radiance
from prt_bake.network.settings import NetworkSettings

ROWS, WARPS = 128, 8
"""Rows and warps of a program of `network_rows`."""
OPTIONS = {"num_stages": 3, "enable_fp_fusion": True}
LATE_ROWS, LATE_WARPS = {"float32": 128, "bfloat16": 64}, {"float32": 8, "bfloat16": 4}
"""Rows and warps of a program of `late_rows`."""
FREQUENCIES_PER_STEP = {"float32": 32, "bfloat16": 64}
"""Frequencies that a program turns into features at a time."""
VIEWS_PER_BATCH = 4096
"""A GPU takes as long for one view as for a full batch."""
MAX_WIDTH = 128
ROWS_PER_BATCH = 1 << 20
"""Rows whose results are copied while the next ones are computed."""
TABLE_ROWS = 1 << 16
"""Maximum of (rotation, direction) rows in a table: 128 MiB with 256 frequencies."""
COMPUTE_CAPABILITIES = {"float32": (9, 10), "bfloat16": (8, 9, 10, 11, 12)}
"""Major compute capabilities on which the kernels run. Older GPUs lack the matrix units, others the shared memory that
float32 needs."""

Launch = Callable[[Tensor, slice], None]
"""(result [n·D,3], views): computes the rows of these views."""
Launcher = Callable[[LightTable], Launch]
"""Light table → the launch for a block's views under these directions."""


def cuda_network(network: NetworkCore, precision: str, device: str) -> FusedNetwork:
    """The network on a GPU: with kernels if the settings, the GPU and Triton (part of torch's CUDA builds) allow it.

    Warns with a RuntimeWarning and falls back to fused layers if kernels that should work fail.
    """
    major = torch.cuda.get_device_capability(device)[0]
    if supports(network.settings) and major in COMPUTE_CAPABILITIES[precision] and find_spec("triton") is not None:
        try:
            return warmed_up(CudaNetwork(network, precision, device))
        except Exception as fault:  # compilers, drivers and small GPUs raise many types of errors
            warnings.warn(
                f"the network's GPU kernels failed on {device} ({type(fault).__name__}: {fault}); evaluation without "
                "them takes several times as long. Triton needs a C compiler, such as gcc, to compile them",
                RuntimeWarning,
                stacklevel=4,
            )
    return FusedNetwork(network, precision, device)


def warmed_up(network: "CudaNetwork") -> "CudaNetwork":
    """The same network after one evaluation, which compiles its kernels."""
    up, middle = np.array([0.0, 0.0, 1.0]), network.network.box_min.cpu().numpy() + 0.5 * network.network.box_side
    network.evaluate_block(up[None, None], np.zeros((1, 1), np.int64), middle[None], up[None, None])
    return network


def supports(settings: NetworkSettings) -> bool:
    """Whether the kernels support these layers."""
    width = settings.width
    if width & (width - 1) or not MIN_TILE <= width <= MAX_WIDTH:
        return False
    if not settings.trunk:
        over_one = all(source == target - 2 for source, target in settings.skips)
        unique = len(set(settings.skips)) == len(settings.skips)
        return over_one and unique and settings.features % max(FREQUENCIES_PER_STEP.values()) == 0
    return all(source <= settings.trunk for source, target in settings.skips if target > settings.trunk)


class CudaNetwork(FusedNetwork):
    """A `FusedNetwork` whose blocks run in kernels; for settings that `supports` accepts."""

    def __init__(self, network: NetworkCore, precision: str = "float32", device: str = "cuda") -> None:
        """Copies the weights to `device` in `precision`, in the kernels' layout."""
        super().__init__(network, precision, device)
        settings = self.network.settings
        self._outputs = _padded(self._weights[-1], MIN_TILE)
        self._bias = _padded(self._biases[-1].float(), MIN_TILE)
        if self._late is None:
            width = settings.width
            blocks = [part for weight in self._weights[1:-1] for part in torch.split(weight, width, dim=1)]
            blocks = blocks or [torch.zeros((width, width), dtype=self._dtype, device=self._device)]
            self._square = torch.stack([*blocks, torch.zeros_like(blocks[0])])
            self._bias = torch.cat([*(bias.float() for bias in self._biases[:-1]), self._bias])
        else:
            squares = self._late.late_weights()
            self._square = torch.stack(squares) if squares else self._outputs
            self._pair_columns = PairColumns.of(self.network)
            pair_weights = [_padded(weight, self._pair_columns.columns).T for weight in self._late.pair_weights]
            self._pair_weights = torch.stack(pair_weights).contiguous()
            self._recorded_views = RecordedGraph(self._view_terms, VIEWS_PER_BATCH, self._device)
        self._copy_stream = stream(self._device) if self._device.type == "cuda" else None

    def __reduce__(self) -> tuple[Any, ...]:
        return CudaNetwork, (self.network, self.precision, str(self._device))

    def exact(self) -> FusedNetwork:
        """The same network in float32; without kernels if the GPU lacks those of float32."""
        return self if self.precision == "float32" else cuda_network(self.network, "float32", str(self._device))

    def evaluate_block(
        self, incident: ArrayLike, rotation: ArrayLike, positions: ArrayLike, outgoing: ArrayLike
    ) -> NDArray[np.float32]:
        """Ŝ [N,B,D,3] in 1/sr, float32: `FusedNetwork.evaluate_block`."""
        if self.network.only_low:
            return super().evaluate_block(incident, rotation, positions, outgoing)
        light = np.asarray(incident)
        directions = light.shape[1]
        shape = np.shape(rotation)
        parts = []
        with torch.inference_mode():
            chosen = torch.from_numpy(np.array(rotation, np.int32).reshape(-1)).to(self._device)
            launcher = self._network_launcher if self._late is None else self._late_launcher
            launch = launcher(chosen, positions, outgoing)
            for first, last in table_bounds(light, TABLE_ROWS):
                table = self._light_table(incident, light[:, first:last], complete=last - first == directions)
                parts.append(self._copied(len(chosen), last - first, launch(table)))
        results = [part.reshape(*shape, -1, 3) for part in parts]
        return results[0] if len(results) == 1 else np.concatenate(results, axis=2)

    def _network_launcher(self, chosen: Tensor, positions: ArrayLike, outgoing: ArrayLike) -> Launcher:
        """Launches `network_rows` for these views of a network whose first layer sees all inputs."""
        from prt_bake.network.inference.cuda_kernels import network_rows

        settings, view = self.network.settings, self._views(positions, outgoing)[0]
        view = view.half() if self.precision == "bfloat16" else view
        skips = sum(1 << target for _source, target in settings.skips)

        def launcher(light: LightTable) -> Launch:
            def launch(result: Tensor, views: slice) -> None:
                network_rows[(-(-len(result) // ROWS),)](
                    result, light.table, chosen[views], view[views], self._weights[0], self._square, self._bias,
                    self._outputs, len(result), light.directions.shape[1], self.network.output_scale,
                    FEATURES=settings.features, WIDTH=settings.width, LAYERS=settings.layers, SKIPS=skips,
                    STEP=FREQUENCIES_PER_STEP[self.precision], ROWS=ROWS, num_warps=WARPS, **self._kernel_options(),
                )  # fmt: skip

            return launch

        return launcher

    def _late_launcher(self, chosen: Tensor, positions: ArrayLike, outgoing: ArrayLike) -> Launcher:
        """Launches `late_rows` for these views of a network whose late layers see ωi."""
        from prt_bake.network.inference.cuda_kernels import late_rows

        settings, columns = self.network.settings, self._pair_columns
        queries = self._view_queries(positions, outgoing)
        terms, eye = self._recorded_views(queries), queries[:, 3:6].float().contiguous()
        lobes, band = terms.lobes or (terms.frame,) * 3, self.network.band
        rows = LATE_ROWS[self.precision]

        def launcher(light: LightTable) -> Launch:
            sets, directions = light.directions.shape[:2]

            def launch(result: Tensor, views: slice) -> None:
                late_rows[(-(-len(result) // rows),)](
                    result, light.table, chosen[views], terms.added[:, views], light.directions, eye[views],
                    terms.frame[views], columns.grids, columns.numbers, columns.lengths, self._pair_weights,
                    self._square, self._outputs, self._bias, *(part[views] for part in lobes), len(result), directions,
                    sets, terms.added.shape[1], self.network.output_scale,
                    WIDTH=settings.width, LAYERS=settings.light_layers, POWERS=settings.angle_powers,
                    FRAME_ROWS=terms.frame.shape[1], LIGHT_PLACES=settings.light_places, PAIRS=columns.columns,
                    LOBES=settings.lobes, BANDS=0 if band is None else band + 1, ROWS=rows,
                    num_warps=LATE_WARPS[self.precision], **self._kernel_options(),
                )  # fmt: skip
                if terms.correction.shape[1]:
                    added = low_radiance(
                        terms.correction[views], low_harmonics(light.directions[chosen[views]]), LOW_DEGREE
                    )
                    result.view(added.shape).add_(added, alpha=self.network.output_scale)

            return launch

        return launcher

    def _kernel_options(self) -> dict[str, Any]:
        relu = self.network.settings.activation == "relu"
        return {"RELU": relu, "EXACT": self.precision == "float32", "OUTPUTS": MIN_TILE, **OPTIONS}

    def _copied(self, views: int, directions: int, launch: Launch) -> NDArray[np.float32]:
        """The result [views,D,3] of launches, copied to the host while later launches run."""
        result = torch.empty((views, directions, 3), device=self._device)
        host = torch.empty(result.shape, pin_memory=True) if self._copy_stream is not None else result
        batch = max(1, ROWS_PER_BATCH // directions)
        for first in range(0, views, batch):
            rows = slice(first, min(first + batch, views))
            launch(result[rows].view(-1, 3), rows)
            if self._copy_stream is not None:
                self._copy_stream.wait_stream(torch.cuda.current_stream(self._device))
                with torch.cuda.stream(self._copy_stream):
                    host[rows].copy_(result[rows], non_blocking=True)
        if self._copy_stream is not None:
            self._copy_stream.synchronize()
        return np.asarray(host.numpy())

    def _new_light_table(self, light: NDArray[Any]) -> LightTable:
        known = super()._new_light_table(light)
        halved = self._late is None and self.precision == "bfloat16"
        return known._replace(table=known.table.half()) if halved else known

    def _view_queries(self, positions: ArrayLike, outgoing: ArrayLike) -> Tensor:
        """Position, outgoing direction, normal (0 without a mesh) and path of each view [N·B,9+…], in one transfer."""
        outgoing = np.asarray(outgoing, np.float64)
        x = torch.from_numpy(np.repeat(np.asarray(positions, np.float64), outgoing.shape[1], axis=0))
        eye = torch.from_numpy(outgoing.reshape(-1, 3))
        normals = self.network.mesh_normals(x, eye)
        normals = torch.zeros_like(x) if normals is None else normals
        return torch.cat((x, eye, normals, self.network.packed_paths(x, eye, normals)), dim=1).to(self._device)

    def _view_terms(self, queries: Tensor) -> ViewTerms:
        """What late layers need of views [N,9+…], in operations that a CUDA graph can record."""
        x, eye, normals, paths = torch.split(queries, [3, 3, 3, queries.shape[1] - 9], dim=1)
        network, late = self.network, self._late
        assert late is not None
        frame = torch.zeros((len(x), network.settings.frame_rows, 3), device=self._device)
        if network.view is None:
            features = network.view_features(x, eye)
        else:
            encoding = network.view.encode(network.relative_positions(x), eye, normals, known_paths(paths.float()))
            features, frame = network.view.features(encoding), encoding.frame
        added, lobes, correction = late.view_parts(features)
        parts: Lobes | Bands | None = lobes
        if lobes is not None and network.band is not None:
            parts = lobe_bands(lobes, network.band)
        correction = frame.new_zeros((len(x), 0, 3)) if correction is None else correction
        return ViewTerms(added, frame, tuple(part.float().contiguous() for part in parts or ()), correction)


def _padded(rows: Tensor, count: int) -> Tensor:
    """The rows, padded with rows of zeros to `count`."""
    return torch.cat((rows, rows.new_zeros((count - len(rows), *rows.shape[1:])))).contiguous()
