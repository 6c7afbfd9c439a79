"""Weights of an earlier network as the start of a training: of the same object with another material, or nearly so.

What the shape does to light is then known already, and only what the new material changes is learned.
"""

from dataclasses import asdict, replace

import torch
from torch import Tensor

from formats.errors import ModelError
from prt_bake.network.bssrdf import NeuralBSSRDF
from prt_bake.network.features.feature_grid import FeatureGrid
from prt_bake.network.low_bands import LowBands, low_bands_of
from prt_bake.network.settings import DIRECTION_INPUTS, EXIT_INPUTS, INPUTS_PER_CHANNEL, NetworkSettings

_MAY_DIFFER = {
    "interfaces",
    "branches",
    "inner_bodies",
    "low_width",
    "low_layers",
    "low_axes",
    "correction_width",
    "lobes",
    "material_channels",
    "material_parts",
    "grid_places",
}
"""Settings that depend on the scene, and whose weights can be copied in part."""


def start_from(network: NeuralBSSRDF, earlier: NeuralBSSRDF) -> None:
    """Give a network the weights and the output scale of an earlier one, as far as both have the same inputs.

    Weights of inputs that only the new network has are 0, and learned features are interpolated at its nodes. Low bands
    of another depth begin again. Raises ModelError if the layers differ otherwise, as between the presets.
    """
    new, before = network.settings, earlier.settings
    refuse_other_layers(new, before)
    network.output_scale = earlier.output_scale
    weights = {name: weight.detach().to(network.box_min.device) for name, weight in earlier.named_parameters()}
    with torch.no_grad():
        for name, weight in network.named_parameters():
            if name.startswith("low.") or name not in weights or weights[name].shape[0] != weight.shape[0]:
                continue
            if name == "hidden.0.weight":
                _copy_columns(weight, weights[name], new, before)
            else:
                # The last inputs of late layers are the cosines, which not all networks have.
                columns = min(weight.shape[-1], weights[name].shape[-1])
                weight[..., columns:] = 0.0
                weight[..., :columns] = weights[name][..., :columns]
        if network.view is not None and earlier.view is not None:
            _interpolate(network.view.grid, earlier.view.grid)
    same_layers = (new.low_width, new.low_layers) == (before.low_width, before.low_layers)
    if network.low is not None and earlier.low is not None and same_layers:
        _copy_low_bands(network.low, earlier.low, new, before)


def earlier_low_bands(new: NetworkSettings, earlier: NeuralBSSRDF) -> LowBands | None:
    """The low bands of an earlier network, for the inputs of one with settings `new`; None if these lack some."""
    before = earlier.settings
    fewer_axes = before.low_axes and not new.low_axes
    fewer_parts = before.material_parts not in (0, new.material_parts)
    *_, material, _parts, leaving = _columns(new)
    *_, material_before, _parts, leaving_before = _columns(before)
    if earlier.low is None or fewer_axes or fewer_parts or (material, leaving) != (material_before, leaving_before):
        return None
    low = low_bands_of(replace(new, low_width=before.low_width, low_layers=before.low_layers), torch.Generator())
    assert low is not None
    _copy_low_bands(low, earlier.low, new, before)
    return low


def refuse_other_layers(new: NetworkSettings, earlier: NetworkSettings) -> None:
    """Raise ModelError if the weights of one network cannot be the start of another."""
    before = asdict(earlier)
    differing = {name: value for name, value in asdict(new).items() if value != before[name]}
    for name, value in differing.items():
        if name not in _MAY_DIFFER or _columns(new)[0] != _columns(earlier)[0]:
            raise ModelError(
                f"the network to start from has {name} {before[name]!r}, that of this scene {value!r}; train without "
                "the earlier one"
            )


def _columns(settings: NetworkSettings) -> list[int]:
    """Inputs of the first layer: those of every network, directions, the material, its parts, and the ray's exit."""
    directions = DIRECTION_INPUTS if settings.low_axes else 0
    material, in_parts = (count * settings.material_channels for count in (INPUTS_PER_CHANNEL, settings.material_parts))
    leaving = EXIT_INPUTS if settings.lobes else 0
    others = directions, material, in_parts, leaving
    return [settings.view_inputs - sum(others), *others]


@torch.no_grad()
def _copy_low_bands(low: LowBands, before: LowBands, new: NetworkSettings, earlier: NetworkSettings) -> None:
    """Copy low bands of the same depth; lobes about axes that only the new ones have are 0."""
    weights = dict(before.named_parameters())
    for name, weight in low.named_parameters():
        if name == "hidden.0.weight":
            _copy_columns(weight, weights[name], new, earlier)
        elif weight.shape == weights[name].shape:
            weight.copy_(weights[name])
        else:
            rows = min(len(weight), len(weights[name]))
            weight.zero_()[:rows].copy_(weights[name][:rows])


def _copy_columns(weight: Tensor, before: Tensor, new: NetworkSettings, earlier: NetworkSettings) -> None:
    parts, parts_before = torch.split(weight, _columns(new), dim=1), torch.split(before, _columns(earlier), dim=1)
    for part, part_before in zip(parts, parts_before, strict=True):
        if part.shape == part_before.shape:
            part.copy_(part_before)
        else:
            part.zero_()


def _interpolate(grid: FeatureGrid | None, earlier: FeatureGrid | None) -> None:
    """Set the features at a grid's nodes to those of an earlier grid there."""
    if grid is None or earlier is None:
        return
    nodes = (grid.corner + torch.nonzero(grid.row_index) / grid.per_side).to(earlier.rows.device)
    grid.rows[1:] = earlier(nodes[:, None], torch.ones(len(nodes), 1, device=nodes.device)).to(grid.rows.device)
