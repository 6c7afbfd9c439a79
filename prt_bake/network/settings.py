"""The settings of a neural BSSRDF, with the paper's values as defaults.

Source: the paper's section on network architecture: Fourier features (Tancik et al. 2020), five hidden layers of 128
ReLU, layer 1 concatenated to the input of layer 3 and layer 2 to that of layer 4, a linear layer to RGB.
"""

from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, cast

from formats.errors import ModelError
from formats.json_values import is_number

Activation = Literal["relu", "silu"]
DirectionForm = Literal["spherical", "cartesian"]

COSINE_BUMPS = 8
"""Gaussian bumps that encode the cosine of ωo and the normal."""
SHAPE_SCALES = (0.015, 0.03, 0.06, 0.12)
"""Standard deviations of the Gaussians that blur the object's shape, in box sides."""
SHAPE_INPUTS = 4 * len(SHAPE_SCALES)
"""Inputs per point that describe the object's shape around it: occupancy and its slope at each scale."""
MAX_GRID_PLACES, MAX_GRID_NUMBERS = 128, 64
MOST_CHANNELS = 8
"""Most channels of the material."""
MATERIAL_BLURS = (0.0, 0.03, 0.07)
"""Standard deviations, in box sides, of the Gaussians that blur the material's channels."""
INPUTS_PER_CHANNEL = 2 * len(MATERIAL_BLURS)
"""The channel at x, and its mean along the view ray, with each blur."""
LIGHT_RAY_ORIGINS = ("x", "within")
"""Origins of the light rays: x itself, and the middle sample of the view ray."""
AXIS_LENGTH = 3.0
"""Length of unit vectors among the inputs of a view, which otherwise have a mean square of ½."""
DIRECTION_INPUTS = 6
"""Inputs that give the directions of the view ray before and after it is refracted at x."""
EXIT_INPUTS = 3
"""Inputs that give the direction of the view ray after it has left the object; they are the last ones."""
LEAST_LAYERS = 3
"""Hidden layers of corrections, and the fewest of low bands (`prt_bake.network.low_bands`)."""


@dataclass(frozen=True)
class NetworkSettings:
    """The architecture of a network; raises ModelError if the values are inconsistent."""

    features: int = 256
    """Fourier frequencies; each gives a cosine and a sine."""
    feature_mean: float = 18.0
    """Mean of the entries of the frequency matrix G, in cycles per unit of input."""
    feature_spread: float = 1.0
    """Standard deviation of the entries of G that act on directions."""
    width: int = 128
    layers: int = 5
    """Hidden layers, without the linear layer to RGB."""
    skips: tuple[tuple[int, int], ...] = ((1, 3), (2, 4))
    """(source, target): the output of hidden layer `source` is appended to the input of `target`; counted from 1."""
    activation: Activation = "relu"
    directions: DirectionForm = "spherical"
    """spherical: (θ/π, φ/2π) about the z axis of object space, φ in [0, 2π). cartesian: the unit vector."""
    seed: int = 0
    """Draws G and the initial weights."""
    position_spread: float = 1.0
    """Standard deviation of the entries of G that act on the position."""
    light_layers: int = 0
    """Number of last hidden layers that see ωi. 0 (the paper): ωi enters the first layer together with x and ωo.
    Otherwise separate Fourier features of ωi are appended to the inputs of these layers, and the layers before them,
    the trunk, run once for all incident directions of a query."""
    light_features: int = 32
    """Fourier frequencies of ωi if light_layers > 0."""
    light_spread: float = 0.25
    """Standard deviation of these frequencies; their mean is 0."""
    angle_powers: int = 0
    """Powers of ωi·ωo, from the first, that the late layers see: single scattering depends on them."""
    ray_samples: int = 0
    """Samples along the view ray over which the features of x are averaged (`features.view_features`). 0: features of x
    itself. Needs light_layers, Cartesian directions, a feature_mean of 0, and an `Interior`."""
    tells_normal: bool = False
    """Whether the view ray is refracted at the interface, and the normal is an input."""
    interfaces: int = 0
    """How often a view ray is bent or reflected at most in a clear object (`features.view_path`); 0: it is straight."""
    branches: int = 1
    """Most branches of such a ray, which interfaces split into a refracted and a reflected part; 1: it is refracted
    unless it is totally reflected."""
    low_width: int = 0
    """Width of the layers that predict the coefficients to degree 2 of a view (`prt_bake.network.low_bands`); 0: none.
    Needs light_layers."""
    low_layers: int = LEAST_LAYERS
    """Their hidden layers, at least LEAST_LAYERS."""
    low_axes: bool = False
    """Whether they predict lobes about axes of the view, too: its direction before and after refraction, the normal,
    and the slopes of the shape. The two directions are then inputs. Needs ray_samples."""
    correction_width: int = 0
    """Width of the layers that correct the bands to degree 2 of the values (`prt_bake.network.low_bands`); 0: none.
    Needs low_width."""
    lobes: int = 0
    """Narrow lobes in ωi that the trunk predicts for each view (`prt_bake.network.lobes`)."""
    shape_places: int = 0
    """Points at which the object's blurred shape is an input: x and others along the view ray (`features.shape`)."""
    grid_places: int = 0
    """Nodes per box side of the grid of learned features (`features.feature_grid`); 0: no grid. Needs ray_samples."""
    grid_numbers: int = 8
    """Learned features per node; the inputs are those at x and their mean along the view ray."""
    material_channels: int = 0
    """Most channels of the material that are inputs (`features.material`); 0: none. A network's settings have the
    number of channels of its interior."""
    material_parts: int = 0
    """Parts of the view ray with equal numbers of samples; the mean of each channel along each part is an input. 0:
    none. They show in which order the ray passes the materials."""
    light_places: int = 0
    """Points along light rays at which the late layers see the object's occupancy, half of them on the ray from x and
    half on the ray from within (`features.light_ray`). Needs ray_samples."""

    light_cosines: bool = False
    """Whether the late layers see the cosines of ωi to the normal and to the slopes of the shape around x, if these are
    inputs."""
    inner_bodies: bool = False
    """Whether the shape, and the occupancy along light rays, show the bodies inside, too (`Interior.occupancy`). The
    cosines are then also those to the slopes at the middle of the view ray, where it often meets a body."""

    def __post_init__(self) -> None:
        for name in ("features", "width", "layers", "light_features", "branches"):
            if getattr(self, name) < 1:
                raise ModelError(f"network settings: {name} must be at least 1, found {getattr(self, name)}")
        if self.activation not in ("relu", "silu"):
            raise ModelError(f"network settings: activation must be relu or silu, found {self.activation!r}")
        if self.directions not in ("spherical", "cartesian"):
            raise ModelError(f"network settings: directions must be spherical or cartesian, found {self.directions!r}")
        self._check_layers()
        self._check_view_ray()

    def _check_layers(self) -> None:
        if not 0 <= self.light_layers < self.layers:
            raise ModelError(
                f"network settings: light_layers must be at least 0 and below layers ({self.layers}), "
                f"found {self.light_layers}"
            )
        if self.angle_powers < 0 or (self.angle_powers and not self.trunk):
            raise ModelError(
                "network settings: angle_powers must not be negative, and must be 0 without light_layers; "
                f"found {self.angle_powers}"
            )
        for source, target in self.skips:
            if not 1 <= source < target - 1 < self.layers:
                raise ModelError(
                    f"network settings: skip ({source}, {target}) must lead from a hidden layer past the next one, "
                    f"within layers 1 to {self.layers}"
                )

    def _check_view_ray(self) -> None:
        if self.low_width < 0 or (self.low_width and not self.trunk):
            raise ModelError(
                "network settings: low_width must not be negative, and must be 0 without light_layers; "
                f"found {self.low_width}"
            )
        if self.low_layers < LEAST_LAYERS:
            raise ModelError(f"network settings: low_layers must be at least {LEAST_LAYERS}, found {self.low_layers}")
        if self.low_axes and not self.ray_samples:
            raise ModelError("network settings: low_axes needs ray_samples; found 0")
        if self.correction_width < 0 or (self.correction_width and not self.low_width):
            raise ModelError(
                "network settings: correction_width must not be negative, and must be 0 without low_width; "
                f"found {self.correction_width}"
            )
        if self.lobes < 0 or (self.lobes and not self.tells_normal):
            raise ModelError(
                f"network settings: lobes must not be negative, and must be 0 without tells_normal; found {self.lobes}"
            )
        if min(self.ray_samples, self.interfaces) < 0 or (self.tells_normal and not self.ray_samples):
            raise ModelError(
                "network settings: ray_samples and interfaces must not be negative, tells_normal needs ray_samples; "
                f"found {self.ray_samples}, {self.interfaces} with tells_normal {self.tells_normal}"
            )
        if self.interfaces and not self.tells_normal:
            raise ModelError(f"network settings: interfaces needs tells_normal; found {self.interfaces} without it")
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
            raise ModelError(f"network settings: grid_places needs ray_samples; found {self.grid_places} and 0")
        if not 0 <= self.material_channels <= MOST_CHANNELS:
            raise ModelError(
                f"network settings: material_channels must be from 0 to {MOST_CHANNELS}, found {self.material_channels}"
            )
        if self.material_parts < 0 or (self.material_parts and self.ray_samples % self.material_parts):
            raise ModelError(
                f"network settings: material_parts must divide ray_samples ({self.ray_samples}) or be 0, "
                f"found {self.material_parts}"
            )
        uneven = self.light_places % len(LIGHT_RAY_ORIGINS)
        if self.light_places < 0 or uneven or (self.light_places and not self.ray_samples):
            raise ModelError(
                "network settings: light_places must be even and not negative, and must be 0 without ray_samples; "
                f"found {self.light_places}"
            )
        if self.ray_samples and not (self.trunk and self.direction_inputs == 3 and self.feature_mean == 0.0):
            raise ModelError(
                "network settings: ray_samples needs light_layers, cartesian directions and a feature_mean of 0, found "
                f"{self.light_layers}, {self.directions}, {self.feature_mean:g}"
            )

    @property
    def direction_inputs(self) -> int:
        """Inputs per direction."""
        return 2 if self.directions == "spherical" else 3

    @property
    def trunk(self) -> int:
        """Hidden layers that do not see ωi; 0 if all do."""
        return self.layers - self.light_layers if self.light_layers else 0

    @property
    def pair_inputs(self) -> int:
        """Inputs of a late layer that depend on the view and ωi together: powers of ωi·ωo, occupancies, cosines."""
        return self.angle_powers + self.light_places + self.light_axes

    @property
    def frame_rows(self) -> int:
        """Vectors of a view that are combined with ωi: origins of light rays, and axes."""
        return len(LIGHT_RAY_ORIGINS) + self.light_axes

    @property
    def light_axes(self) -> int:
        """Axes of a view whose cosines to ωi are inputs."""
        if not self.light_cosines:
            return 0
        return int(self.tells_normal) + len(SHAPE_SCALES) * len(self.sloped_places)

    @property
    def sloped_places(self) -> tuple[int, ...]:
        """Places of the shape, 0 for x, whose slopes are axes."""
        places = (0, (self.shape_places + 1) // 2) if self.inner_bodies else (0,)
        return places if self.shape_places > 1 else places[: self.shape_places]

    @property
    def light_inputs(self) -> int:
        """Inputs of a late layer that depend on ωi: its Fourier features, then those of the view and ωi together."""
        return 2 * self.light_features + self.pair_inputs

    @property
    def extra_view_inputs(self) -> int:
        """Inputs of the first layer other than Fourier features."""
        samples = self.ray_samples + 1 if self.ray_samples else 0
        shape = SHAPE_INPUTS * self.shape_places
        grid = 2 * self.grid_numbers if self.grid_places else 0
        material = (INPUTS_PER_CHANNEL + self.material_parts) * self.material_channels
        directions = DIRECTION_INPUTS if self.low_axes else 0
        return samples + shape + grid + self.normal_inputs + directions + material + (EXIT_INPUTS if self.lobes else 0)

    @property
    def normal_inputs(self) -> int:
        """Inputs of the first layer that give the normal, and its cosine to ωo."""
        return 3 + COSINE_BUMPS if self.tells_normal else 0

    @property
    def axis_columns(self) -> tuple[int, ...]:
        """The first of the three inputs of each axis of `low_axes`, among those of the first layer."""
        if not self.low_axes:
            return ()
        first = (2 * self.grid_numbers if self.grid_places else 0) + 2 * self.features
        shape = first + self.normal_inputs + self.ray_samples + 1
        directions = shape + SHAPE_INPUTS * self.shape_places
        slopes = range(shape + 1, directions, SHAPE_INPUTS // len(SHAPE_SCALES))
        normal = (first,) if self.tells_normal else ()
        return (*normal, *slopes, *range(directions, directions + DIRECTION_INPUTS, 3))

    @property
    def view_inputs(self) -> int:
        """Inputs of the first layer."""
        return 2 * self.features + self.extra_view_inputs

    @property
    def layer_shapes(self) -> tuple[tuple[int, int], ...]:
        """(outputs, inputs) of every layer, the linear layer to RGB last.

        The inputs of a layer are, in this order, the output of the layer before (for the first, the features), the
        outputs of its skip sources, and the inputs that depend on ωi if it is a late layer.
        """
        hidden = []
        for layer in range(1, self.layers + 1):
            straight = self.view_inputs if layer == 1 else self.width
            light = self.light_inputs if 0 < self.trunk < layer else 0
            hidden.append((self.width, straight + self.width * len(self.sources(layer)) + light))
        return (*hidden, (3, self.width))

    def sources(self, layer: int) -> tuple[int, ...]:
        """The hidden layers whose outputs are appended to the input of `layer`; counted from 1."""
        return tuple(source for source, target in self.skips if target == layer)

    def as_json(self) -> dict[str, Any]:
        """Plain values, as stored in a checkpoint."""
        return asdict(self)

    @staticmethod
    def from_json(values: dict[str, Any]) -> "NetworkSettings":
        """The inverse of `as_json`; raises ModelError naming a key that is unknown or of the wrong type."""
        known = {field.name: field.default for field in fields(NetworkSettings)}
        values = dict(values)
        if values.pop("ray_turns", 0):
            raise ModelError(
                "network settings: the network was trained with view rays that were reflected in a coarse grid "
                "(ray_turns), which are now followed in the meshes; train the model again"
            )
        resolved: dict[str, Any] = {}
        for name, value in values.items():
            if name not in known:
                raise ModelError(f"network settings: unknown key {name!r}; known are {', '.join(known)}")
            if name == "skips":
                resolved[name] = _skips_from_json(value)
            else:
                resolved[name] = _scalar(name, value, type(known[name]))
        return NetworkSettings(**resolved)


def _scalar(name: str, value: Any, expected: type) -> int | float | str | bool:
    if expected is float and isinstance(value, int) and is_number(value):
        return float(value)
    if type(value) is not expected:
        raise ModelError(f"network settings: {name} must be of type {expected.__name__}, found {value!r}")
    if expected is float and not is_number(value):
        raise ModelError(f"network settings: {name} must be finite in float32, found {value!r}")
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
        interfaces=64,
        branches=16,
        low_width=128,
        low_layers=5,
        low_axes=True,
        lobes=2,
        shape_places=4,
        grid_places=32,
        material_channels=MOST_CHANNELS,
        material_parts=4,
        light_places=16,
        light_cosines=True,
        inner_bodies=True,
    ),
}
"""`paper`: as published. `measured`: lower error after the same training (`make bench` compares both)."""
