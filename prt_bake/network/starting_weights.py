"""Weights of an earlier network as the start of a training: of the same object with another material, or nearly so.

What the shape does to light is then known already, and only what the new material changes is learned.
"""

from dataclasses import asdict

import torch
from torch import Tensor

from formats.errors import ModelError
from prt_bake.network.bssrdf import NeuralBSSRDF
from prt_bake.network.features.feature_grid import FeatureGrid
from prt_bake.network.settings import EXIT_INPUTS, INPUTS_PER_CHANNEL, NetworkSettings

_MAY_DIFFER = {
    "interfaces",
    "branches",
    "inner_bodies",
    "low_width",
    "low_layers",
    "correction_width",
    "lobes",
    "material_channels",
    "grid_places",
}
"""Settings that depend on the scene, and whose weights can be copied in part."""
_FIRST_LAYERS = "hidden.0.weight", "low.hidden.0.weight"
"""Their inputs are those of a view."""


def start_from(network: NeuralBSSRDF, earlier: NeuralBSSRDF) -> None:
    """Give a network the weights and the output scale of an earlier one, as far as both have the same inputs.

    Weights of inputs that only the new network has are 0, and learned features are interpolated at its nodes. Low bands
    of another depth begin anew. Raises ModelError if the layers differ otherwise, as between the presets.
    """
    refuse_other_layers(network.settings, earlier.settings)
    network.output_scale = earlier.output_scale
    weights = {name: weight.detach().to(network.box_min.device) for name, weight in earlier.named_parameters()}
    with torch.no_grad():
        for name, weight in network.named_parameters():
            if name not in weights or weights[name].shape[0] != weight.shape[0]:
                continue
            if name.startswith("low.") and network.settings.low_layers != earlier.settings.low_layers:
                continue
            if name in _FIRST_LAYERS:
                _copy_columns(weight, weights[name], network.settings, earlier.settings)
            else:
                # The last inputs of late layers are the cosines, which not all networks have.
                columns = min(weight.shape[-1], weights[name].shape[-1])
                weight[..., columns:] = 0.0
                weight[..., :columns] = weights[name][..., :columns]
        if network.view is not None and earlier.view is not None:
            _interpolate(network.view.grid, earlier.view.grid)


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
    """Inputs of the first layer: those of every scene, of the material, and of the view ray's exit."""
    material = INPUTS_PER_CHANNEL * settings.material_channels
    leaving = EXIT_INPUTS if settings.lobes else 0
    return [settings.view_inputs - material - leaving, material, leaving]


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
