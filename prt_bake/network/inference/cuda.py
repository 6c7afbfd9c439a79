"""A frozen network on a graphics card: one kernel from a block's rows to RGB, and views as one recorded graph.

What a bake asks for at a time is little (some hundred views): a card would spend its time being asked for hundreds of
steps, each of some microseconds. Here a lot of views is one step, and so are all their rows (`card_kernels`). Answers
arrive in page-locked memory while later ones are computed: elsewhere it takes longer to fetch them than to find them.
"""

import warnings
from collections.abc import Callable
from importlib.util import find_spec
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from prt_bake.network.inference.cuda_views import MIN_TILE, PairColumns, RecordedGraph, ViewTerms, stream
from prt_bake.network.inference.fused import FusedNetwork, LightTable
from prt_bake.network.lobes import Bands, Lobes, lobe_bands
from prt_bake.network.settings import NetworkSettings

if TYPE_CHECKING:
    from prt_bake.network.bssrdf import NeuralBSSRDF

ROWS, WARPS = 128, 8
"""Of a program of a kernel."""
OPTIONS = {"num_stages": 3, "enable_fp_fusion": True}
LATE_ROWS, LATE_WARPS = {"float32": 128, "bfloat16": 64}, {"float32": 8, "bfloat16": 4}
PIECE = {"float32": 32, "bfloat16": 64}
"""Frequencies that a program turns into features at once."""
VIEWS_PER_BATCH = 4096
"""A lot of views takes a card as long if it is full as if it holds one."""
MOST_WIDTH = 128
ROWS_PER_BATCH = 1 << 20
"""Whose answers are fetched while those of the next are computed."""
TABLE_ROWS = 1 << 16
"""Most (rotation, direction) rows whose table is held at once: 128 MiB with 256 frequencies."""
COMPUTE_CAPABILITIES = {"float32": (9, 10), "bfloat16": (8, 9, 10, 11, 12)}
"""Of cards that have kernels: the others lack the memory that those of float32 need, or units that do the products."""


def cuda_network(network: "NeuralBSSRDF", precision: str, device: str) -> FusedNetwork:
    """The network on a card: by kernels where there are some for it (Triton comes with torch for cards), else step by
    step; with a RuntimeWarning where there should be some.
    """
    major = torch.cuda.get_device_capability(device)[0]
    if takes(network.settings) and major in COMPUTE_CAPABILITIES[precision] and find_spec("triton") is not None:
        try:
            return tried(CudaNetwork(network, precision, device))
        except Exception as fault:  # whatever a compiler, a driver or a small card may say
            warnings.warn(
                f"the kernels for networks cannot be used on {device} ({type(fault).__name__}: {fault}); without them "
                "it takes several times as long, and Triton needs a C compiler, such as gcc, to make them",
                RuntimeWarning,
                stacklevel=4,
            )
    return FusedNetwork(network, precision, device)


def tried(network: "CudaNetwork") -> "CudaNetwork":
    """The same, once its kernels have answered: they are compiled then."""
    up, middle = np.array([0.0, 0.0, 1.0]), network.network.box_min.cpu().numpy() + 0.5 * network.network.box_side
    network.evaluate_block(up[None, None], np.zeros((1, 1), np.int64), middle[None], up[None, None])
    return network


def takes(settings: NetworkSettings) -> bool:
    """Whether the kernels can do such layers."""
    width = settings.width
    if width & (width - 1) or not MIN_TILE <= width <= MOST_WIDTH:
        return False
    if not settings.trunk:
        joined = all(source == target - 2 for source, target in settings.skips)
        once = len(set(settings.skips)) == len(settings.skips)
        return joined and once and settings.features % max(PIECE.values()) == 0
    return all(source <= settings.trunk for source, target in settings.skips if target > settings.trunk)


class CudaNetwork(FusedNetwork):
    """As `FusedNetwork`, for settings that `takes` says yes to."""

    def __init__(self, network: "NeuralBSSRDF", precision: str = "float32", device: str = "cuda") -> None:
        """Copies the weights to `device` in `precision`, laid out for the kernels."""
        super().__init__(network, precision, device)
        settings = self.network.settings
        if self.network.view is not None:
            self.network.view.use_kernels = True
        self._outputs = _padded(self._weights[-1], MIN_TILE)
        self._bias = _padded(self._biases[-1].float(), MIN_TILE)
        if self._late is None:
            width = settings.width
            blocks = [part for weight in self._weights[1:-1] for part in torch.split(weight, width, dim=1)]
            blocks = blocks or [torch.zeros((width, width), dtype=self._dtype, device=self._device)]
            self._square = torch.stack([*blocks, torch.zeros_like(blocks[0])])
            self._bias = torch.cat([*(bias.float() for bias in self._biases[:-1]), self._bias])
        else:
            squares = self._late.squares()
            self._square = torch.stack(squares) if squares else self._outputs
            self._pair_columns = PairColumns.of(self.network)
            told = [_padded(weight, self._pair_columns.columns).T for weight in self._late.pair_weights]
            self._of_pairs = torch.stack(told).contiguous()
            self._views_of = RecordedGraph(self._seen, VIEWS_PER_BATCH, self._device)
        self._copying = stream(self._device) if self._device.type == "cuda" else None

    def __reduce__(self) -> tuple[Any, ...]:
        return CudaNetwork, (self.network, self.precision, str(self._device))

    def evaluate_block(
        self, incident: ArrayLike, rotation: ArrayLike, positions: ArrayLike, outgoing: ArrayLike
    ) -> NDArray[np.float32]:
        """Ŝ [N,B,D,3] in 1/sr, float32: `FusedNetwork.evaluate_block`."""
        light = np.asarray(incident)
        copies, directions = light.shape[:2]
        shape = np.shape(rotation)
        step = -(-directions // -(-directions // max(1, TABLE_ROWS // copies)))
        bounds = [*range(0, directions, step), directions]
        parts = []
        with torch.inference_mode():
            chosen = torch.from_numpy(np.array(rotation, np.int32).reshape(-1)).to(self._device)
            launch = self._launch_whole if self._late is None else self._launch_late
            ask = launch(chosen, positions, outgoing)
            for first, last in pairwise(bounds):
                known = self._known_of_light(incident, light[:, first:last], whole=last - first == directions)
                parts.append(self._fetched(len(chosen), last - first, ask(known)))
        answer = [part.reshape(*shape, -1, 3) for part in parts]
        return answer[0] if len(answer) == 1 else np.concatenate(answer, axis=2)

    def _launch_whole(self, chosen: Tensor, positions: ArrayLike, outgoing: ArrayLike) -> "Ask":
        """What computes rows of a network whose first layer sees everything, for these views."""
        from prt_bake.network.inference.cuda_kernels import network_rows

        settings, view = self.network.settings, self._views(positions, outgoing)[0]
        view = view.half() if self.precision == "bfloat16" else view
        joined = sum(1 << target for _source, target in settings.skips)

        def ask(known: LightTable) -> "Launch":
            def launch(answer: Tensor, some: slice) -> None:
                network_rows[(-(-len(answer) // ROWS),)](
                    answer, known.table, chosen[some], view[some], self._weights[0], self._square, self._bias,
                    self._outputs, len(answer), known.towards.shape[1], self.network.output_scale,
                    FEATURES=settings.features, WIDTH=settings.width, LAYERS=settings.layers, JOINED=joined,
                    PIECE=PIECE[self.precision], ROWS=ROWS, num_warps=WARPS, **self._how(),
                )  # fmt: skip

            return launch

        return ask

    def _launch_late(self, chosen: Tensor, positions: ArrayLike, outgoing: ArrayLike) -> "Ask":
        """What computes rows of a network that sees ωi late."""
        from prt_bake.network.inference.cuda_kernels import late_rows

        settings, columns = self.network.settings, self._pair_columns
        asked = self._view_queries(positions, outgoing)
        seen, along = self._views_of(asked), asked[:, 3:6].float().contiguous()
        lobes, band = seen.lobes or (seen.frame,) * 3, self.network.band
        rows_each = LATE_ROWS[self.precision]

        def ask(known: LightTable) -> "Launch":
            sets, directions = known.towards.shape[:2]

            def launch(answer: Tensor, some: slice) -> None:
                late_rows[(-(-len(answer) // rows_each),)](
                    answer, known.table, chosen[some], seen.added[:, some], known.towards, along[some],
                    seen.frame[some], columns.grids, columns.numbers, columns.lengths, self._of_pairs, self._square,
                    self._outputs, self._bias, *(part[some] for part in lobes), len(answer), directions, sets,
                    seen.added.shape[1], self.network.output_scale,
                    WIDTH=settings.width, LAYERS=settings.light_layers, POWERS=settings.angle_powers,
                    FRAME_VECTORS=seen.frame.shape[1], LIGHT_PLACES=settings.light_places, PAIRS=columns.columns,
                    LOBES=settings.lobes, BANDS=0 if band is None else band + 1, ROWS=rows_each,
                    num_warps=LATE_WARPS[self.precision], **self._how(),
                )  # fmt: skip

            return launch

        return ask

    def _how(self) -> dict[str, Any]:
        relu = self.network.settings.activation == "relu"
        return {"RELU": relu, "EXACT": self.precision == "float32", "OUTPUTS": MIN_TILE, **OPTIONS}

    def _fetched(self, views: int, directions: int, launch: "Launch") -> NDArray[np.float32]:
        """Answers [views,D,3], fetched as they come."""
        there = torch.empty((views, directions, 3), device=self._device)
        here = torch.empty(there.shape, pin_memory=True) if self._copying is not None else there
        at_once = max(1, ROWS_PER_BATCH // directions)
        for first in range(0, views, at_once):
            some = slice(first, min(first + at_once, views))
            launch(there[some].view(-1, 3), some)
            if self._copying is not None:
                self._copying.wait_stream(torch.cuda.current_stream(self._device))
                with torch.cuda.stream(self._copying):
                    here[some].copy_(there[some], non_blocking=True)
        if self._copying is not None:
            self._copying.synchronize()
        return np.asarray(here.numpy())

    def _of_light(self, light: NDArray[Any]) -> LightTable:
        known = super()._of_light(light)
        halved = self._late is None and self.precision == "bfloat16"
        return known._replace(table=known.table.half()) if halved else known

    def _view_queries(self, positions: ArrayLike, outgoing: ArrayLike) -> Tensor:
        """Of each view position, outgoing direction, and normal, which is 0 where no mesh tells it [N·B,9]: all that a
        card must be sent of it, at once.
        """
        eye = np.asarray(outgoing, np.float64)
        asked = np.zeros((*eye.shape[:2], 9))
        asked[..., :3], asked[..., 3:6] = np.asarray(positions, np.float64)[:, None], eye
        asked = asked.reshape(-1, 9)
        normals = self.network._normals(torch.from_numpy(asked[:, :3]), torch.from_numpy(asked[:, 3:6]))
        if normals is not None:
            asked[:, 6:] = normals.numpy()
        return torch.from_numpy(asked).to(self._device)

    def _seen(self, asked: Tensor) -> ViewTerms:
        """What is known of views before any light falls on them; in steps that can be recorded."""
        x, eye, normals = torch.split(asked, 3, dim=1)
        network, late = self.network, self._late
        assert late is not None
        frame = torch.zeros((len(x), network.settings.frame_rows, 3), device=self._device)
        if network.view is None:
            features = network.view_features(x, eye)
        else:
            told = network.view.told(network._relative(x), eye, normals)
            features, frame = network.view.learnt(told), told.frame
        added, lobes = late.bins(features)
        known: Lobes | Bands | None = lobes
        if lobes is not None and network.band is not None:
            known = lobe_bands(lobes, network.band)
        return ViewTerms(added, frame, tuple(part.float().contiguous() for part in known or ()))


Launch = Callable[[Tensor, slice], None]
"""(answers [n·D,3], views): computes the rows of some views."""
Ask = Callable[[LightTable], Launch]
"""What is known of directions of incidence → what computes a block's rows."""


def _padded(rows: Tensor, count: int) -> Tensor:
    """With zeros behind, `count` of them in all."""
    return torch.cat((rows, rows.new_zeros((count - len(rows), *rows.shape[1:])))).contiguous()
