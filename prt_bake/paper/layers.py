"""The paper's ablation: MSE by number of hidden layers, with and without skips, relative to 7 layers with skips."""

import math
from collections.abc import Callable
from dataclasses import replace

from formats.errors import QueryError
from formats.scene import Scene
from prt_bake.network.bssrdf import PRESETS, NetworkSettings
from prt_bake.paper.artefacts import Artefacts
from prt_bake.paper.models import train_once
from prt_bake.paper.results import as_number
from prt_bake.tracer.prepared import no_values_reason

LAYERS = (3, 4, 5, 6, 7)
_STANDARD = "7"


def network_settings(layers: int, skips: bool) -> NetworkSettings:
    """Return the measured preset with `layers` hidden layers; each skip bypasses one layer, and none enters the last.

    Five layers have the paper's skips, from 1 to 3 and from 2 to 4. Three layers have the skip from 1 to 3.
    """
    last = max(3, layers - 1)
    pairs = tuple((source, source + 2) for source in range(1, last - 1)) if skips else ()
    return replace(PRESETS["measured"], layers=layers, skips=pairs)


def variants() -> dict[str, NetworkSettings]:
    """Return the networks by their names in the plot: "5" with skips, "5*" without."""
    return {
        f"{layers}{'' if skips else '*'}": network_settings(layers, skips)
        for layers in LAYERS
        for skips in (True, False)
    }


def ablation(
    artefacts: Artefacts,
    name: str,
    scene: Scene,
    minutes: float,
    device: str,
    progress: Callable[[str, float, str], None],
) -> dict[str, float]:
    """Return the squared relative RMSE of Ŝ by network, relative to 7 layers with skips, on the same fresh queries.

    Trains each network for `minutes` and keeps it, so that a stopped ablation resumes. Raises Stopped.
    """
    errors: dict[str, float] = {}
    for network, settings in variants().items():
        file = f"{name}/layers/{network.replace('*', '_without_skips')}.pt"
        label = f"{name}: {network} layers"

        def report(share: float, text: str, label: str = label) -> None:
            progress(label, share, text)

        model = train_once(artefacts, file, scene, minutes, device, report, settings)
        errors[network] = as_number(model.facts["relative_rmse"]["transport"]) ** 2
    return relative(errors)


def refuse_without_values(scene: Scene) -> None:
    """Raise QueryError for a scene in which Ŝ has no values to compare."""
    if reason := no_values_reason(scene):
        raise QueryError(
            f"{scene.path}: {reason}; Ŝ has no values there whose errors --layers could compare; choose another --scene"
        )


def relative(errors: dict[str, float]) -> dict[str, float]:
    """Return the errors relative to 7 layers with skips; nan for unknown ones, and if that error is 0."""
    standard = errors[_STANDARD]
    return {network: error / standard if standard > 0.0 else math.nan for network, error in errors.items()}
