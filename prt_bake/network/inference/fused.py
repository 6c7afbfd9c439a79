"""Fast evaluation of a frozen network for baking: many view bins, each lit from one of R copies of a direction set.

If ωi enters the first layer, the phases of x, ωo and ωi add, so exp(i·phase) is a product of three precomputed tables:
one row per (rotation, direction), one per vertex, one per bin. An evaluation then costs one complex product per
frequency and the matrix products. Networks whose late layers see ωi cost far less: see `late_layers`.

Rows are computed in tiles of one fixed size that stay in cache. The rounding of a row depends on the shape of the
matrix product; with fixed tiles a result does not depend on how the vertices are cut into blocks.
"""

from collections.abc import Iterable, Iterator, Sequence
from copy import deepcopy
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from formats.errors import QueryError
from prt_bake.network.core import NetworkCore
from prt_bake.network.features.fourier import encode_directions
from prt_bake.network.inference.late_layers import LateLayers
from prt_bake.network.inference.light_tables import CachedTables, LightTable, table_bounds
from prt_bake.network.inference.linear import linear_for
from prt_bake.network.inference.product_kernel import product_rows
from prt_bake.network.lobes import Bands, Lobes, evaluate_bands, evaluate_lobes, lobe_bands
from prt_bake.network.low_bands import low_harmonics, low_radiance
from prt_bake.network.queries import float64_tensor, require_finite

PRECISIONS = {"float32": torch.float32, "bfloat16": torch.bfloat16}
ROWS_PER_TILE = {"cpu": 2048, "cuda": 1 << 17}
VIEWS_PER_BATCH = {"cpu": 256, "cuda": 1024}
"""Views whose features are computed together: they stay in cache; a GPU takes as long for a few as for many."""
LIGHTS_PER_BATCH = 1024
"""Incident directions whose features are computed together, in matrix products of one shape."""
TABLE_ROWS = 1 << 14
"""Maximum of (rotation, direction) rows in a table: 32 MiB with 256 frequencies."""


class FusedNetwork:
    """A frozen network behind `evaluate` and `evaluate_block`; safe to call from several threads."""

    def __init__(self, network: NetworkCore, precision: str = "float32", device: str = "cpu") -> None:
        """Copies the weights to `device` in `precision` ("float32" or "bfloat16"); raises QueryError on others."""
        if precision not in PRECISIONS:
            raise QueryError(f"precision must be one of {', '.join(PRECISIONS)}, found {precision!r}")
        network.warn_without_mesh()  # here, because the copy cannot be given a mesh
        self.network = deepcopy(network).to(device).eval()
        self.metadata = network.metadata
        self.precision = precision
        self._dtype = PRECISIONS[precision]
        self._device = torch.device(device)
        kind = "cpu" if self._device.type == "cpu" else "cuda"
        self._rows, self._views_per_batch = ROWS_PER_TILE[kind], VIEWS_PER_BATCH[kind]
        settings = network.settings
        self._skips = [settings.sources(layer) for layer in range(1, settings.layers + 1)]
        self._activation = settings.activation
        layers: list[Any] = [*self.network.hidden, self.network.output]
        self._weights = [layer.weight.detach().to(self._dtype).contiguous() for layer in layers]
        self._biases = [layer.bias.detach().to(self._dtype) for layer in layers]
        self._linear = linear_for(self._weights[-1])
        self._late = LateLayers(self.network, self._dtype, self._linear) if settings.trunk else None
        self._tables = CachedTables()

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the network and the settings; a copy in another process is rebuilt for its processor."""
        return FusedNetwork, (self.network, self.precision, str(self._device))

    def evaluate(self, incident: ArrayLike, positions: ArrayLike, outgoing: ArrayLike) -> NDArray[np.float32]:
        """Ŝ [N,D,3] by the reference in float32: `NetworkCore.evaluate`."""
        return self.network.evaluate(incident, positions, outgoing)

    def exact(self) -> "FusedNetwork":
        """The same network in float32."""
        return self if self.precision == "float32" else FusedNetwork(self.network, "float32", str(self._device))

    def evaluate_block(
        self, incident: ArrayLike, rotation: ArrayLike, positions: ArrayLike, outgoing: ArrayLike
    ) -> NDArray[np.float32]:
        """Ŝ [N,B,D,3] in 1/sr, float32.

        Bin (n, b) is at positions[n], is seen along outgoing[n, b] and lit from incident[rotation[n, b]]:

        incident [R,D,3] unit vectors; rotation [N,B] integers below R; positions [N,3] in object space; outgoing
        [N,B,3]. Agrees with `evaluate` to about 10⁻⁵ of the output's size in float32, 10⁻² in bfloat16. The tables of a
        few incident arrays are cached for later calls with the same array objects.
        """
        light = np.asarray(incident)
        vertices, bins = np.shape(rotation)
        directions = light.shape[1]
        result = np.empty((vertices * bins, directions, 3), dtype=np.float32)
        with torch.inference_mode():
            chosen = torch.as_tensor(np.asarray(rotation, dtype=np.int64).reshape(-1), device=self._device)
            view, frame = self._views(positions, outgoing)
            if self.network.only_low:
                self._fill_low(result, _float32(light, self._device), chosen, view)
                return result.reshape(vertices, bins, directions, 3)
            eye = _float32(np.reshape(outgoing, (-1, 3)), self._device)
            for first, last in table_bounds(light, TABLE_ROWS):
                table = self._light_table(incident, light[:, first:last], complete=last - first == directions)
                part = result[:, first:last]
                if self._late is not None:
                    self._fill_late(self._late, part, table, chosen, view, (eye, frame))
                elif self._device.type == "cpu":
                    self._fill_compiled(part, table.table, chosen, view)
                else:
                    self._fill(part, table.table, chosen, view)
        return result.reshape(vertices, bins, directions, 3)

    def _fill_late(
        self,
        late: LateLayers,
        result: NDArray[np.float32],
        light: LightTable,
        chosen: Tensor,
        view: Tensor,
        pair_inputs: tuple[Tensor, Tensor],
    ) -> None:
        """As `_fill`, for late networks; pair_inputs are outgoing directions [N·B,3] and frames [N·B,·,3]."""
        layers, _rotations, directions, width = light.table.shape
        tile, count = max(1, self._rows // directions), len(chosen)
        terms = torch.zeros((layers, tile, directions, width), dtype=self._dtype, device=self._device)
        harmonics = None if self.network.correction is None else low_harmonics(light.directions)
        chosen, eye, frame = (_padded(part, tile) for part in (chosen, *pair_inputs))
        bins_per_batch = tile * max(1, self._rows // tile)
        for begin in range(0, count, bins_per_batch):
            batch = view[begin : begin + bins_per_batch]
            view_terms, lobes, correction = self._trunk(late, batch, tile)
            for first in range(0, len(batch), tile):
                # Every operation runs on a full tile: the last digits of a row depend on the shape of the product.
                rows = slice(begin + first, begin + first + tile)
                for layer in range(layers):
                    torch.index_select(light.table[layer], 0, chosen[rows], out=terms[layer])
                incident = light.directions[chosen[rows]]
                pairs = self.network.pair_features(incident, eye[rows], frame[rows])
                added = late.add_views(terms, view_terms[:, first : first + tile], pairs)
                radiance = late.radiance(added).view(tile, directions, 3).float()
                if isinstance(lobes, Lobes):
                    radiance = radiance + evaluate_lobes(Lobes(*_rows(lobes, first, tile)), incident)
                elif lobes is not None:
                    radiance = radiance + evaluate_bands(Bands(*_rows(lobes, first, tile)), incident)
                if correction is not None and harmonics is not None:
                    radiance = radiance + torch.bmm(harmonics[chosen[rows]], correction[first : first + tile])
                last = min(begin + first + tile, count)
                scaled = (radiance * self.network.output_scale).cpu().numpy()
                result[begin + first : last] = scaled[: last - begin - first]

    def _fill_low(self, result: NDArray[np.float32], light: Tensor, chosen: Tensor, view: Tensor) -> None:
        """As `_fill`, for networks of low bands alone, under incident directions [R,D,3]."""
        tile = max(1, self._rows // light.shape[1])
        coefficients, harmonics = self.low_coefficients(view), low_harmonics(light)
        for first in range(0, len(chosen), tile):
            rows = slice(first, first + tile)
            radiance = self._low_radiance(coefficients[rows], harmonics[chosen[rows]])
            result[rows] = radiance.cpu().numpy()

    def low_coefficients(self, view: Tensor) -> Tensor:
        """a_lm [N,9,3] over the output scale of views [N,·], in batches of one fixed size, as `_trunk`."""
        assert self.network.low is not None
        size, low = self._views_per_batch, self.network.low
        return torch.cat([low(_padded(part, size - len(part)))[: len(part)] for part in torch.split(view, size)])

    def _low_radiance(self, coefficients: Tensor, harmonics: Tensor) -> Tensor:
        """Ŝ [N,D,3] up to the network's band, of coefficients [N,9,3] and harmonics [N,D,9]."""
        return low_radiance(coefficients, harmonics, self.network.band or 0) * self.network.output_scale

    def _trunk(self, late: LateLayers, view: Tensor, tile: int) -> tuple[Tensor, Lobes | Bands | None, Tensor | None]:
        """Contributions [layers, ≥ N + tile, width] of views [N,·] to the late layers, their lobes or bands, and the
        coefficients of their correction.

        Runs batches of one fixed size, so that the result does not depend on how bins are cut.
        """
        parts = []
        for first in range(0, len(view), self._views_per_batch):
            some = view[first : first + self._views_per_batch]
            batch = torch.zeros((self._views_per_batch, view.shape[1]), dtype=view.dtype, device=self._device)
            batch[: len(some)] = some
            parts.append(late.view_parts(batch))
        terms = torch.cat([part.terms for part in parts], dim=1)
        terms = torch.nn.functional.pad(terms, (0, 0, 0, tile))
        corrections = [part.correction for part in parts if part.correction is not None]
        correction = _padded(torch.cat(corrections), tile) if corrections else None
        lobes = [part.lobes for part in parts if part.lobes is not None]
        if not lobes:
            return terms, None, correction
        if self.network.band is None:
            return terms, Lobes(*_concatenated(lobes, tile)), correction
        return terms, Bands(*_concatenated([lobe_bands(part, self.network.band) for part in lobes], tile)), correction

    def _fill_compiled(self, result: NDArray[np.float32], table: Tensor, chosen: Tensor, view: Tensor) -> None:
        """As `_fill`, with compiled features; bins with the same rotation run together, so its table stays in cache."""
        directions, width = table.shape[1:]
        tile = max(1, self._rows // directions)
        features = np.zeros((tile * directions, width), np.float32 if self._dtype is torch.float32 else np.uint16)
        rows = torch.from_numpy(features).view(self._dtype)
        light, views, rotations = table.numpy(), view.numpy(), chosen.numpy()
        order = np.argsort(rotations, kind="stable")
        for first in range(0, len(order), tile):
            some = order[first : first + tile]
            product_rows(light, rotations[some], views[some], features)
            radiance = self._layers(rows).view(tile, directions, 3)[: len(some)].float() * self.network.output_scale
            result[some] = radiance.numpy()

    def _fill(self, result: NDArray[np.float32], table: Tensor, chosen: Tensor, view: Tensor) -> None:
        """Fills result [N·B,D,3] in fixed tiles of complete bins; unused rows of the last tile hold older features."""
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
            result[first : first + bins] = radiance.cpu().numpy()

    def _layers(self, h: Tensor) -> Tensor:
        activations: list[Tensor] = []
        for sources, weight, bias in zip(self._skips, self._weights, self._biases, strict=False):
            if sources:
                h = torch.cat((h, *(activations[source - 1] for source in sources)), dim=1)
            h = self._linear(h, weight, bias, self._activation)
            activations.append(h)
        return self._linear(h, self._weights[-1], self._biases[-1], "none")

    def _views(self, positions: ArrayLike, outgoing: ArrayLike) -> tuple[Tensor, Tensor]:
        """Precomputed values [N·B,·] of bins, and their frames [N·B,·,3] (`ViewEncoding.frame`).

        The values are the cosines and sines of the phases of x and ωo if ωi enters the first layer, else the inputs of
        the first layer.
        """
        if self.network.view is None:
            phases = self._cycles("positions", positions)[:, None, :] + self._cycles("outgoing", outgoing)
            exponentials = _exponential(phases).reshape(-1, phases.shape[-1])
            return _cosines_and_sines(exponentials), torch.empty((len(exponentials), 0, 3), device=self._device)
        eye = torch.from_numpy(np.array(outgoing, np.float64))
        x = torch.from_numpy(np.array(positions, np.float64))[:, None].expand_as(eye)
        require_finite("positions", x)
        require_finite("outgoing", eye)
        return self.view_rows(x.reshape(-1, 3), eye.reshape(-1, 3))

    def view_rows(self, positions: Tensor, outgoing: Tensor) -> tuple[Tensor, Tensor]:
        """`NetworkCore.view_features` [N, view_inputs], and the frames of the views, 0 for networks without an
        interior.

        Runs batches of one fixed size, so that no row depends on the others of a batch.
        """
        count = len(positions)
        features = torch.empty((count, self.network.settings.view_inputs), device=self._device)
        frame = torch.zeros((count, self.network.settings.frame_rows, 3), device=self._device)
        for first in range(0, count, self._views_per_batch):
            rows = slice(first, min(first + self._views_per_batch, count))
            size = rows.stop - first
            x, eye = torch.zeros((2, self._views_per_batch, 3), dtype=torch.float64, device=self._device)
            x[:size], eye[:size] = positions[rows], outgoing[rows]
            encoding = self.network.encode_views(x, eye)
            features[rows] = self.network.view_features(x, eye, encoding)[:size]
            if encoding is not None:
                frame[rows] = encoding.frame[:size]
        return features, frame

    def _cycles(self, part: str, vectors: ArrayLike) -> Tensor:
        """The share of one input in Gu [..., features], in cycles modulo 1, float32; the shares add up to Gu modulo 1.

        part: "incident" (if it enters the first layer), "positions" or "outgoing".
        """
        network, settings = self.network, self.network.settings
        values = float64_tensor(vectors, network.frequencies.device)
        size = settings.direction_inputs
        begin = 0 if settings.trunk else size
        columns = {
            "incident": slice(0, begin),
            "positions": slice(begin, begin + 3),
            "outgoing": slice(begin + 3, begin + 3 + size),
        }
        positions = part == "positions"
        u = network.relative_positions(values) if positions else encode_directions(values, settings.directions)
        return ((u @ network.frequencies[:, columns[part]].double().T) % 1.0).float()

    def _light_table(self, key: ArrayLike, light: NDArray[Any], complete: bool) -> LightTable:
        """The table of incident directions [R,D,3], cached by the array object `key` if `complete`."""
        if complete:
            return self._tables.find(key, lambda: self._new_light_table(light))
        return self._new_light_table(light)

    def _new_light_table(self, light: NDArray[Any]) -> LightTable:
        incident = _float32(light, self._device)
        if self._late is None:
            return LightTable(_cosines_and_sines(_exponential(self._cycles("incident", light))), incident)
        directions = torch.from_numpy(np.array(light, np.float64)).to(self._device)
        rows, parts = directions.reshape(-1, 3), []
        for first in range(0, len(rows), LIGHTS_PER_BATCH):
            # Full batches always: the rounding of a row must not depend on how many others there are.
            batch = torch.zeros((LIGHTS_PER_BATCH, 3), dtype=rows.dtype, device=self._device)
            last = min(first + LIGHTS_PER_BATCH, len(rows))
            batch[: last - first] = rows[first:last]
            table = self._late.light_table(self.network.light_features(batch))
            parts.append(table[:, : last - first])
        return LightTable(torch.cat(parts, dim=1).view(-1, *directions.shape[:-1], parts[0].shape[-1]), incident)


def _concatenated(parts: Sequence[Iterable[Tensor]], padding: int) -> Iterator[Tensor]:
    """The tensors [N,...] of tuples, concatenated, and `padding` rows of zeros at the end."""
    for tensors in zip(*parts, strict=True):
        yield _padded(torch.cat(tensors), padding)


def _padded(rows: Tensor, padding: int) -> Tensor:
    """[N,...] and `padding` rows of zeros; torch 2.6 cannot `pad` rows without columns."""
    return torch.cat((rows, rows.new_zeros((padding, *rows.shape[1:]))))


def _rows(parts: Iterable[Tensor], first: int, count: int) -> Iterator[Tensor]:
    return (part[first : first + count] for part in parts)


def _float32(directions: Any, device: torch.device) -> Tensor:
    return torch.from_numpy(np.array(directions, np.float32)).to(device)


def _exponential(cycles: Tensor) -> Tensor:
    return torch.polar(torch.ones_like(cycles), (2.0 * torch.pi) * cycles)


def _cosines_and_sines(exponentials: Tensor) -> Tensor:
    """Real parts, then imaginary parts, along the last axis."""
    return torch.cat((exponentials.real, exponentials.imag), dim=-1)
