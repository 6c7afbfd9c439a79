"""The numbers that define a neural BSSRDF, with the paper's values as defaults.

Source: the paper's section on network architecture: Fourier features (Tancik et al. 2020), five hidden layers of 128
ReLU, layer 1 joined to the input of layer 3 and layer 2 to that of layer 4, a linear layer to RGB.
"""

from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, cast

from formats.errors import ModelError

Activation = Literal["relu", "silu"]
DirectionForm = Literal["spherical", "cartesian"]

COSINE_BUMPS = 8
SHAPE_INPUTS = 16
"""Numbers that tell of the object's shape around a place."""
MAX_GRID_PLACES, MAX_GRID_NUMBERS = 128, 64
SHAPE_SCALES = (0.015, 0.03, 0.06, 0.12)
"""At which an object's shape is told: standard deviations of the Gaussians that blur it, in sides of its box."""
LIGHT_RAY_ORIGINS = ("x", "within")
"""Whence the way to the light is looked along: x itself, and half-way between the places along the ray of view."""
EXIT_INPUTS = 3
"""Numbers that tell where the ray of view goes once it has left the object; they stand last."""


@dataclass(frozen=True)
class NetworkSettings:
    """What a network is built from; raises ModelError if the numbers make no network."""

    features: int = 256
    """Fourier frequencies; each gives a cosine and a sine."""
    feature_mean: float = 18.0
    """Mean of the entries of the frequency matrix G, in cycles per unit of input."""
    feature_spread: float = 1.0
    """Standard deviation of the entries of G that act on directions."""
    width: int = 128
    layers: int = 5
    """Hidden layers, the linear layer to RGB not counted."""
    skips: tuple[tuple[int, int], ...] = ((1, 3), (2, 4))
    """(source, target): hidden layer `source`'s output is appended to the input of `target`; layers count from 1."""
    activation: Activation = "relu"
    directions: DirectionForm = "spherical"
    """spherical: (θ/π, φ/2π) about object space's z, φ in [0, 2π). cartesian: the unit vector as it is."""
    seed: int = 0
    """Draws G and the initial weights."""
    position_spread: float = 1.0
    """Standard deviation of the entries of G that act on the position."""
    light_layers: int = 0
    """Hidden layers, counted from the last, that see ωi. 0: ωi enters the first one together with x and ωo (the
    paper). Otherwise its own Fourier features are appended to the inputs of so many layers, and those before them are
    run once for all directions of incidence of a query."""
    light_features: int = 32
    """Fourier frequencies of ωi where it enters late."""
    light_spread: float = 0.25
    """Standard deviation of those frequencies, of mean 0."""
    angle_powers: int = 0
    """Powers of ωi·ωo, from the first, told to the layers that see ωi late: light scattered once depends on them."""
    ray_samples: int = 0
    """Places along the ray of view over which the features of x are averaged (`neural.view_features`). 0: features of
    x itself. Needs ωi to enter late, Cartesian directions, a mean of 0, and an `Interior`."""
    tells_normal: bool = False
    """Whether the ray is bent at the interface, and its normal told."""
    ray_turns: int = 0
    """Total reflections through which a ray that is bent is followed (`prt_bake.network.features.view_ray`)."""
    lobes: int = 0
    """Narrow lobes in ωi that the layers before the late ones say of each view (`prt_bake.network.lobes`)."""
    shape_places: int = 0
    """Places, x itself and others along the ray of view, of which the object's shape around them is told
    (`prt_bake.network.features.shape`)."""
    grid_places: int = 0
    """Places a box side of the grid of learned numbers (`prt_bake.network.features.feature_grid`). 0: no grid. Needs
    ray_samples."""
    grid_numbers: int = 8
    """Numbers at each place; what x itself has and the mean along the ray are both told."""
    light_places: int = 0
    """Places on the way to the light, as many seen from x as from within, of which the layers that see ωi late are told
    how much of the object lies there (`prt_bake.network.features.light_ray`). Needs ray_samples."""

    light_cosines: bool = False
    """Whether the layers that see ωi late are told its cosines to the normal and to the slopes of the shape around x,
    where those are told."""

    def __post_init__(self) -> None:
        for name in ("features", "width", "layers", "light_features"):
            if getattr(self, name) < 1:
                raise ModelError(f"network settings: {name} must be at least 1, found {getattr(self, name)}")
        if not 0 <= self.light_layers < self.layers:
            raise ModelError(
                f"network settings: light_layers must be at least 0 and below layers ({self.layers}), "
                f"found {self.light_layers}"
            )
        if self.angle_powers < 0 or (self.angle_powers and not self.trunk):
            raise ModelError(
                "network settings: angle_powers must not be negative, and without light_layers nothing takes them; "
                f"found {self.angle_powers}"
            )
        if self.lobes < 0 or (self.lobes and not self.tells_normal):
            raise ModelError(
                "network settings: lobes must not be negative, and without tells_normal no ray leads to them; "
                f"found {self.lobes}"
            )
        if self.activation not in ("relu", "silu"):
            raise ModelError(f"network settings: activation must be relu or silu, found {self.activation!r}")
        if self.directions not in ("spherical", "cartesian"):
            raise ModelError(f"network settings: directions must be spherical or cartesian, found {self.directions!r}")
        if min(self.ray_samples, self.ray_turns) < 0 or (self.tells_normal and not self.ray_samples):
            raise ModelError(
                "network settings: ray_samples and ray_turns must not be negative, and without the first there is no "
                f"ray to bend; found {self.ray_samples}, {self.ray_turns} with tells_normal {self.tells_normal}"
            )
        if not 0 <= self.shape_places <= self.ray_samples:
            raise ModelError(
                f"network settings: shape_places must be from 0 to ray_samples ({self.ray_samples}), "
                f"found {self.shape_places}"
            )
        if not (0 <= self.grid_places <= MAX_GRID_PLACES and 1 <= self.grid_numbers <= MAX_GRID_NUMBERS):
            raise ModelError(
                f"network settings: grid_places must be from 0 to {MAX_GRID_PLACES} and grid_numbers from 1 to "
                f"{MAX_GRID_NUMBERS}, found {self.grid_places} and {self.grid_numbers}"
            )
        if self.grid_places and not self.ray_samples:
            raise ModelError(f"network settings: without ray_samples there is no grid; found {self.grid_places} places")
        if self.light_places < 0 or self.light_places % len(LIGHT_RAY_ORIGINS) or (self.light_places and not self.ray_samples):
            raise ModelError(
                "network settings: light_places must be even and not negative, and without ray_samples there are "
                f"none; found {self.light_places}"
            )
        if self.ray_samples and not (self.trunk and self.across == 3 and self.feature_mean == 0.0):
            raise ModelError(
                "network settings: ray_samples needs light_layers, cartesian directions and a feature_mean of 0, found "
                f"{self.light_layers}, {self.directions}, {self.feature_mean:g}"
            )
        for source, target in self.skips:
            if not 1 <= source < target - 1 < self.layers:
                raise ModelError(
                    f"network settings: skip ({source}, {target}) must lead from a hidden layer past the next one, "
                    f"within layers 1 to {self.layers}"
                )

    @property
    def across(self) -> int:
        """Numbers per direction."""
        return 2 if self.directions == "spherical" else 3

    @property
    def trunk(self) -> int:
        """Hidden layers that do not see ωi."""
        return self.layers - self.light_layers if self.light_layers else 0

    @property
    def pair_inputs(self) -> int:
        """Numbers that a layer is told of a view and ωi together: powers of ωi·ωo, what lies on the way, cosines."""
        return self.angle_powers + self.light_places + self.light_axes

    @property
    def frame_rows(self) -> int:
        """Rows of what is held against ωi: places whence the way to the light is looked along, and axes."""
        return len(LIGHT_RAY_ORIGINS) + self.light_axes

    @property
    def light_axes(self) -> int:
        """Directions of a view whose cosines to ωi are told."""
        if not self.light_cosines:
            return 0
        return int(self.tells_normal) + (len(SHAPE_SCALES) if self.shape_places else 0)

    @property
    def light_inputs(self) -> int:
        """Numbers that a layer is told where ωi enters late: features of ωi alone, then of the view and ωi together."""
        return 2 * self.light_features + self.pair_inputs

    @property
    def extra_view_inputs(self) -> int:
        """Numbers that the first layer is told of the ray of view besides the Fourier features."""
        places = self.ray_samples + 1 if self.ray_samples else 0
        shape = SHAPE_INPUTS * self.shape_places
        grid = 2 * self.grid_numbers if self.grid_places else 0
        return places + shape + grid + (3 + COSINE_BUMPS if self.tells_normal else 0) + (EXIT_INPUTS if self.lobes else 0)

    @property
    def view_inputs(self) -> int:
        """Numbers that the first layer sees."""
        return 2 * self.features + self.extra_view_inputs

    @property
    def layer_shapes(self) -> tuple[tuple[int, int], ...]:
        """(outputs, inputs) of every layer, the linear layer to RGB last.

        A layer's inputs are, in this order, the output of the one before (the features for the first), those of its
        sources, and the features of ωi if it sees them apart.
        """
        hidden = []
        for layer in range(1, self.layers + 1):
            straight = self.view_inputs if layer == 1 else self.width
            light = self.light_inputs if 0 < self.trunk < layer else 0
            hidden.append((self.width, straight + self.width * len(self.sources(layer)) + light))
        return (*hidden, (3, self.width))

    def sources(self, layer: int) -> tuple[int, ...]:
        """Earlier hidden layers whose outputs are appended to the input of `layer` (counted from 1)."""
        return tuple(source for source, target in self.skips if target == layer)

    def as_json(self) -> dict[str, Any]:
        """Plain values, as a checkpoint keeps them."""
        return asdict(self)

    @staticmethod
    def from_json(values: dict[str, Any]) -> "NetworkSettings":
        """The reverse of `as_json`; raises ModelError naming the key that is unknown or of the wrong kind."""
        known = {field.name: field.default for field in fields(NetworkSettings)}
        resolved: dict[str, Any] = {}
        for name, value in values.items():
            if name not in known:
                raise ModelError(f"network settings: unknown key {name!r}; known are {', '.join(known)}")
            if name == "skips":
                resolved[name] = _skips_from_json(value)
            else:
                resolved[name] = _number_or_word(name, value, type(known[name]))
        return NetworkSettings(**resolved)


def _number_or_word(name: str, value: Any, expected: type) -> int | float | str | bool:
    if expected is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if type(value) is not expected:
        raise ModelError(f"network settings: {name} must be of type {expected.__name__}, found {value!r}")
    return cast(int | float | str | bool, value)


def _skips_from_json(value: Any) -> tuple[tuple[int, int], ...]:
    try:
        return tuple((int(source), int(target)) for source, target in value)
    except (TypeError, ValueError):
        raise ModelError(f"network settings: skips must be pairs of layer numbers, found {value!r}") from None


PRESETS: dict[str, NetworkSettings] = {
    "paper": NetworkSettings(),
    "measured": NetworkSettings(
        features=192,
        feature_mean=0.0,
        feature_spread=0.2,
        position_spread=1.2,
        skips=((1, 3),),
        activation="silu",
        directions="cartesian",
        light_layers=2,
        angle_powers=2,
        ray_samples=12,
        tells_normal=True,
        ray_turns=4,
        lobes=2,
        shape_places=4,
        grid_places=32,
        light_places=16,
        light_cosines=True,
    ),
}
"""`paper`: as published. `measured`: lower error after the same training (`make bench` shows both)."""
