"""The fast way through a frozen network: many view bins, each lit from one of R shared copies of a direction set.

The phases of x, ωo and ωi add, so exp(i·phase) is a product of three precomputed tables: one row per (rotation,
direction), one per vertex, one per bin. What remains per evaluation is one complex product per frequency and the
matrix work. Rows are taken in tiles of one fixed size that stay in cache; a result therefore does not depend on how
the vertices are cut into blocks. Networks that see ωi late need far less: `prt_bake.neural.late_layers`.

On CPUs oneDNN's fused linear + activation is called directly: float32 `F.linear` goes to MKL, which on AMD processors
stays at half of what the vector units can do (107 against 231 GFLOP/s on one Zen 5 core).
"""

from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Sequence
from copy import deepcopy
from itertools import pairwise
from threading import Lock
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from formats.errors import QueryError
from prt_bake.neural.late_layers import LateLayers
from prt_bake.neural.lobes import Bands, Lobes, bands_of, in_bands, in_directions
from prt_bake.neural.product_kernel import product_rows

if TYPE_CHECKING:
    from prt_bake.network import NeuralBSSRDF

PRECISIONS = {"float32": torch.float32, "bfloat16": torch.bfloat16}
ROWS_PER_TILE = {"cpu": 2048, "cuda": 1 << 17}
VIEWS_AT_ONCE = {"cpu": 256, "cuda": 1024}
"""Views whose features are computed at once: they stay in cache; a card takes as long for a few as for many."""
LIGHTS_AT_ONCE = 1024
"""Incident directions whose features are computed at once: a product of one shape, whatever their number."""
TABLES = 12
"""Whole tables that are remembered, those of the arrays that were handed in last."""
TABLE_ROWS = 1 << 14
"""Most (rotation, direction) rows whose exponentials are held at once: 32 MiB with 256 frequencies."""


class OfLight(NamedTuple):
    """What is known of directions of incidence beforehand.

    Attributes:
        table: [R,D,2F] cosines and sines of their phases, or what they add to late layers [layers,R,D,width].
        towards: themselves [R,D,3], float32.
    """

    table: Tensor
    towards: Tensor


Linear = Callable[[Tensor, Tensor, Tensor, str], Tensor]


class FusedNetwork:
    """A frozen network behind `evaluate` and `evaluate_block`; safe to call from several threads."""

    def __init__(self, network: "NeuralBSSRDF", precision: str = "float32", device: str = "cpu") -> None:
        """Copies the weights to `device` in `precision` ("float32" or "bfloat16"); raises QueryError on another one."""
        if precision not in PRECISIONS:
            raise QueryError(f"precision must be one of {', '.join(PRECISIONS)}, found {precision!r}")
        self.network = deepcopy(network).to(device).eval()
        self.metadata = network.metadata
        self.precision = precision
        self._dtype = PRECISIONS[precision]
        self._device = torch.device(device)
        kind = "cpu" if self._device.type == "cpu" else "cuda"
        self._rows, self._views_at_once = ROWS_PER_TILE[kind], VIEWS_AT_ONCE[kind]
        settings = network.settings
        self._skips = [settings.sources(layer) for layer in range(1, settings.layers + 1)]
        self._activation = settings.activation
        layers: list[Any] = [*self.network.hidden, self.network.output]
        self._weights = [layer.weight.detach().to(self._dtype).contiguous() for layer in layers]
        self._biases = [layer.bias.detach().to(self._dtype) for layer in layers]
        self._linear: Linear = _onednn_linear if _onednn_answers(self._weights[-1]) else _plain_linear
        self._late = LateLayers(self.network, self._dtype, self._linear) if settings.trunk else None
        self._lock = Lock()
        self._tables: OrderedDict[int, tuple[ArrayLike, OfLight]] = OrderedDict()

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies in other processes lay out the weights for the processor that they are on."""
        return FusedNetwork, (self.network, self.precision, str(self._device))

    def evaluate(self, incident: ArrayLike, positions: ArrayLike, outgoing: ArrayLike) -> NDArray[np.float32]:
        """Ŝ [N,D,3] by the plain float32 path: `NeuralBSSRDF.evaluate`."""
        return self.network.evaluate(incident, positions, outgoing)

    def exact(self) -> "FusedNetwork":
        """The same network in float32."""
        return self if self.precision == "float32" else self.network.prepared("float32", str(self._device))

    def evaluate_block(
        self, incident: ArrayLike, rotation: ArrayLike, positions: ArrayLike, outgoing: ArrayLike
    ) -> NDArray[np.float32]:
        """Ŝ [N,B,D,3] in 1/sr, float32.

        Bin (n, b) lies at positions[n], is seen along outgoing[n, b] and lit from incident[rotation[n, b]]:

        incident [R,D,3] unit vectors; rotation [N,B] integers below R; positions [N,3] in object space; outgoing
        [N,B,3]. Agrees with `evaluate` to about 10⁻⁵ of the output's size in float32, 10⁻² in bfloat16. The tables of a
        few incident arrays are kept for the next calls with the same objects.
        """
        light = np.asarray(incident)
        copies, directions = light.shape[:2]
        vertices, bins = np.shape(rotation)
        answer = np.empty((vertices * bins, directions, 3), dtype=np.float32)
        step = -(-directions // -(-directions // max(1, TABLE_ROWS // copies)))
        bounds = [*range(0, directions, step), directions]
        with torch.inference_mode():
            chosen = torch.as_tensor(np.asarray(rotation, dtype=np.int64).reshape(-1), device=self._device)
            view, frame = self._views(positions, outgoing)
            eye = _float32(np.reshape(outgoing, (-1, 3)), self._device)
            for first, last in pairwise(bounds):
                known = self._known_of_light(incident, light[:, first:last], whole=last - first == directions)
                if self._late is None and self._device.type == "cpu":
                    self._fill_swept(answer[:, first:last], known.table, chosen, view)
                elif self._late is None:
                    self._fill(answer[:, first:last], known.table, chosen, view)
                else:
                    between = known.towards, eye, frame
                    self._fill_late(self._late, answer[:, first:last], known.table, chosen, view, between)
        return answer.reshape(vertices, bins, directions, 3)

    def _fill_late(
        self,
        late: LateLayers,
        answer: NDArray[np.float32],
        table: Tensor,
        chosen: Tensor,
        view: Tensor,
        between: tuple[Tensor, Tensor, Tensor],
    ) -> None:
        """As `_fill`, from the table [layers, rotations, D, width] of what directions add to the late layers, those
        directions [rotations, D, 3] themselves, the outgoing ones [N·B, 3], and the views' frames.
        """
        layers, _rotations, directions, width = table.shape
        tile, count = max(1, self._rows // directions), len(chosen)
        added = torch.zeros((layers, tile, directions, width), dtype=self._dtype, device=self._device)
        chosen, along, frame = (_with_zeros(part, tile) for part in (chosen, *between[1:]))
        bins_at_once = tile * max(1, self._rows // tile)
        for begin in range(0, count, bins_at_once):
            some = view[begin : begin + bins_at_once]
            of_bins, lobes = self._trunk(late, some, tile)
            for first in range(0, len(some), tile):
                # Whole tiles in all that is done: the last digits of a row depend on the shape that it is done in.
                which = slice(begin + first, begin + first + tile)
                for layer in range(layers):
                    torch.index_select(table[layer], 0, chosen[which], out=added[layer])
                towards = between[0][chosen[which]]
                pairs = self.network.pair_features(towards, along[which], frame[which])
                rows = late.add_views(added, of_bins[:, first : first + tile], pairs)
                radiance = late.radiance(rows).view(tile, directions, 3).float()
                if isinstance(lobes, Lobes):
                    radiance = radiance + in_directions(Lobes(*_rows(lobes, first, tile)), towards)
                elif lobes is not None:
                    radiance = radiance + in_bands(Bands(*_rows(lobes, first, tile)), towards)
                last = min(begin + first + tile, count)
                whole = (radiance * self.network.output_scale).cpu().numpy()
                answer[begin + first : last] = whole[: last - begin - first]

    def _trunk(self, late: LateLayers, view: Tensor, tile: int) -> tuple[Tensor, Lobes | Bands | None]:
        """What views [N,·] add to each later layer [layers, ≥ N + tile, width], and their lobes, as many, or the bands
        of these that are asked for; in lots of one size, whatever their number: the result must not depend on how bins
        are cut.
        """
        parts = []
        for first in range(0, len(view), self._views_at_once):
            some = view[first : first + self._views_at_once]
            seen = torch.zeros((self._views_at_once, view.shape[1]), dtype=view.dtype, device=self._device)
            seen[: len(some)] = some
            parts.append(late.bins(seen))
        of_bins = torch.cat([part for part, _lobes in parts], dim=1)
        of_bins = torch.nn.functional.pad(of_bins, (0, 0, 0, tile))
        lobes = [lobes for _part, lobes in parts if lobes is not None]
        if not lobes:
            return of_bins, None
        if self.network.band is None:
            return of_bins, Lobes(*_together(lobes, tile))
        return of_bins, Bands(*_together([bands_of(some_lobes, self.network.band) for some_lobes in lobes], tile))

    def _fill_swept(self, answer: NDArray[np.float32], table: Tensor, chosen: Tensor, view: Tensor) -> None:
        """As `_fill`, features in one sweep: bins by their copy, so that what they share is still in cache."""
        directions, width = table.shape[1:]
        tile = max(1, self._rows // directions)
        swept = np.zeros((tile * directions, width), np.float32 if self._dtype is torch.float32 else np.uint16)
        rows = torch.from_numpy(swept).view(self._dtype)
        light, seen, copies = table.numpy(), view.numpy(), chosen.numpy()
        order = np.argsort(copies, kind="stable")
        for first in range(0, len(order), tile):
            some = order[first : first + tile]
            product_rows(light, copies[some], seen[some], swept)
            radiance = self._layers(rows).view(tile, directions, 3)[: len(some)].float() * self.network.output_scale
            answer[some] = radiance.numpy()

    def _fill(self, answer: NDArray[np.float32], table: Tensor, chosen: Tensor, view: Tensor) -> None:
        """Runs fixed tiles of whole bins; the last one computes leftovers of the one before in its unused rows."""
        directions, width = table.shape[1:]
        tile = max(1, self._rows // directions)
        rows = torch.ones((tile, directions, width), dtype=self._dtype, device=self._device)
        for first in range(0, len(chosen), tile):
            bins = min(tile, len(chosen) - first)
            a, b = table[chosen[first : first + bins]].chunk(2, dim=-1)
            c, s = view[first : first + bins, None].chunk(2, dim=-1)
            rows[:bins] = torch.cat((a * c - b * s, a * s + b * c), dim=-1)
            radiance = self._layers(rows.flatten(0, 1))
            radiance = radiance.view(tile, directions, 3)[:bins].float() * self.network.output_scale
            answer[first : first + bins] = radiance.cpu().numpy()

    def _layers(self, h: Tensor) -> Tensor:
        activations: list[Tensor] = []
        for sources, weight, bias in zip(self._skips, self._weights, self._biases, strict=False):
            if sources:
                h = torch.cat((h, *(activations[source - 1] for source in sources)), dim=1)
            h = self._linear(h, weight, bias, self._activation)
            activations.append(h)
        return self._linear(h, self._weights[-1], self._biases[-1], "none")

    def _views(self, positions: ArrayLike, outgoing: ArrayLike) -> tuple[Tensor, Tensor]:
        """What is known of each bin beforehand, [N·B, ·]: exp(i·phase) where directions enter with it, else the
        features that the first layer sees; and what is held against ωi, as `view_rows` has it.
        """
        if self.network.view is None:
            exponentials = self._view_exponentials(positions, outgoing)
            return _planes(exponentials), torch.empty((len(exponentials), 0, 3), device=self._device)
        eye = torch.from_numpy(np.array(outgoing, np.float64))
        x = torch.from_numpy(np.array(positions, np.float64))[:, None].expand_as(eye)
        return self.view_rows(x.reshape(-1, 3), eye.reshape(-1, 3))

    def view_rows(self, positions: Tensor, outgoing: Tensor) -> tuple[Tensor, Tensor]:
        """`NeuralBSSRDF.view_features` [N, view_inputs], and `Told.frame`, which is 0 where nothing is told; in lots of
        one size, so that no row depends on those beside it.
        """
        count = len(positions)
        features = torch.empty((count, self.network.settings.view_inputs), device=self._device)
        frame = torch.zeros((count, self.network.settings.frame_rows, 3), device=self._device)
        for first in range(0, count, self._views_at_once):
            some = slice(first, min(first + self._views_at_once, count))
            x, eye = torch.zeros((2, self._views_at_once, 3), dtype=torch.float64, device=self._device)
            x[: some.stop - first], eye[: some.stop - first] = positions[some], outgoing[some]
            told = self.network.told(x, eye)
            features[some] = self.network.view_features(x, eye, told)[: some.stop - first]
            if told is not None:
                frame[some] = told.frame[: some.stop - first]
        return features, frame

    def _view_exponentials(self, positions: ArrayLike, outgoing: ArrayLike) -> Tensor:
        """exp(i·phase) of position and outgoing direction together [N·B, features]."""
        at_x = self.network.cycles("positions", positions)
        along = self.network.cycles("outgoing", outgoing)
        return _exponential(at_x[:, None, :] + along).reshape(-1, along.shape[-1])

    def _known_of_light(self, key: ArrayLike, light: NDArray[Any], whole: bool) -> OfLight:
        """What is known of incident directions [R,D,3] beforehand; that of a few whole arrays is remembered."""
        if not whole:
            return self._of_light(light)
        with self._lock:
            # The array itself is kept beside its table, so that no other takes its number meanwhile.
            if id(key) not in self._tables:
                self._tables[id(key)] = key, self._of_light(light)
                if len(self._tables) > TABLES:
                    self._tables.popitem(last=False)
            self._tables.move_to_end(id(key))
            return self._tables[id(key)][1]

    def _of_light(self, light: NDArray[Any]) -> OfLight:
        towards = _float32(light, self._device)
        if self._late is None:
            return OfLight(_planes(_exponential(self.network.cycles("incident", light))), towards)
        directions = torch.from_numpy(np.array(light, np.float64)).to(self._device)
        rows, parts = directions.reshape(-1, 3), []
        for first in range(0, len(rows), LIGHTS_AT_ONCE):
            # Whole lots, whatever their number: a row must not depend on how many there are beside it.
            some = torch.zeros((LIGHTS_AT_ONCE, 3), dtype=rows.dtype, device=self._device)
            last = min(first + LIGHTS_AT_ONCE, len(rows))
            some[: last - first] = rows[first:last]
            table = self._late.light_table(self.network.light_features(some))
            parts.append(table[:, : last - first])
        return OfLight(torch.cat(parts, dim=1).view(-1, *directions.shape[:-1], parts[0].shape[-1]), towards)


def prepared_for(network: "NeuralBSSRDF", precision: str, device: str) -> FusedNetwork:
    """A frozen copy of the network for a device: on a graphics card by its kernels, where it has some."""
    if device == "cuda" and precision in PRECISIONS:
        from prt_bake.neural.card import network_on

        return network_on(network, precision, device)
    return FusedNetwork(network, precision, device)


def _together(parts: Sequence[Iterable[Tensor]], more: int) -> Iterator[Tensor]:
    """Tuples of tensors [N,...], one after another and then zeros for `more`."""
    for alike in zip(*parts, strict=True):
        yield _with_zeros(torch.cat(alike), more)


def _with_zeros(rows: Tensor, more: int) -> Tensor:
    """[N,...], and zeros for `more` rows; torch 2.6 cannot `pad` rows of no columns."""
    return torch.cat((rows, rows.new_zeros((more, *rows.shape[1:]))))


def _rows(parts: Iterable[Tensor], first: int, many: int) -> Iterator[Tensor]:
    return (part[first : first + many] for part in parts)


def _float32(directions: Any, device: torch.device) -> Tensor:
    return torch.from_numpy(np.array(directions, np.float32)).to(device)


def _exponential(cycles: Tensor) -> Tensor:
    return torch.polar(torch.ones_like(cycles), (2.0 * torch.pi) * cycles)


def _planes(exponentials: Tensor) -> Tensor:
    """Cosines, then sines."""
    return torch.cat((exponentials.real, exponentials.imag), dim=-1)


def _plain_linear(h: Tensor, weight: Tensor, bias: Tensor, activation: str) -> Tensor:
    result = torch.nn.functional.linear(h, weight, bias)
    if activation == "none":
        return result
    return result.relu_() if activation == "relu" else torch.nn.functional.silu(result, inplace=True)


def _onednn_linear(h: Tensor, weight: Tensor, bias: Tensor, activation: str) -> Tensor:
    name = {"silu": "swish"}.get(activation, activation)
    result: Tensor = torch.ops.mkldnn._linear_pointwise(h, weight, bias, name, [], "")
    return result


def _onednn_answers(weight: Tensor) -> bool:
    """Whether oneDNN's fused operator, which torch does not document, exists here and is right for this dtype."""
    if weight.device.type != "cpu" or not hasattr(torch.ops.mkldnn, "_linear_pointwise"):
        return False
    h = torch.linspace(-1.0, 1.0, 8 * weight.shape[1]).view(8, -1).to(weight.dtype)
    bias = torch.linspace(-0.5, 0.5, weight.shape[0]).to(weight.dtype)
    try:
        return all(
            torch.allclose(
                _onednn_linear(h, weight, bias, activation).float(),
                _plain_linear(h, weight, bias, activation).float(),
                rtol=0.02,
                atol=0.02,
            )
            for activation in ("relu", "silu", "none")
        )
    except (AttributeError, RuntimeError):
        return False
