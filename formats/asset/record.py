"""The record of a baked asset; its file is described in `formats.asset.layout`."""

import math
from dataclasses import dataclass, field
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

from formats.asset.error_covariance import ErrorCovariance
from formats.asset.lobes import Lobes
from formats.asset.total_error import ErrorInterval, TotalError
from formats.mesh import Mesh
from formats.summary import summary

if TYPE_CHECKING:
    import pyvista

Storage = Literal["float16", "float32"]

FOLDED_IN = "cosines, Fresnel transmission, visibility and scattering, self-shadowing included"


@dataclass(frozen=True, kw_only=True)
class AssetHead:
    """The part of an asset that is known before the bake starts.

    Attributes:
        mesh: the baked mesh; a file stores positions as float32 relative to the centre of the bounding box.
        tangents: [V,3], unit, perpendicular to the vertex normals: the direction φ = 0 of the view bins.
        rings: number of view bins over cosθ.
        sectors: number of view bins over φ.
        directions: [B,3], bin centres in the local frame (tangent, normal × tangent, normal).
        degree: of the spherical harmonics.
        check_directions: [2,3], two unit directions.
        check_values: [2,K], the basis functions at these directions.
        up: the scene's axis that points up, "y" or "z".
        handedness: "right", always.
        unit: the scene's unit of length.
        quantity: "transfer", or "radiance" for an asset baked under one light (K = 1).
        folded_in: text that lists what the coefficients include; for "radiance" the hash of the light.
        left_out: what was pruned to save time or space, dictionaries with item, reason and saving.
        network_error: of the baked network's coefficients compared with path-traced ones; None if it is unknown.
    """

    mesh: Mesh
    tangents: NDArray[np.floating]
    rings: int
    sectors: int
    directions: NDArray[np.floating]
    degree: int
    check_directions: NDArray[np.floating]
    check_values: NDArray[np.floating]
    up: str = "y"
    handedness: str = "right"
    unit: str = "unit"
    quantity: str = "transfer"
    folded_in: str = FOLDED_IN
    left_out: list[dict[str, Any]] = field(default_factory=list)
    network_error: ErrorInterval | None = None

    __repr__ = summary


@dataclass(frozen=True, kw_only=True)
class Asset(AssetHead):
    """A baked asset, in memory or on disk.

    Attributes:
        coefficients: float16 or float32 [V,B,K,C], an array or the open dataset of a file, or `CompactCoefficients`,
            which are decoded on indexing. B and C may be 1 and are then broadcast.
        standard_error: [V,B] (or [V,1]), one sigma of the coefficients, root mean square over K and C.
        valid: bool [V], false for vertices that were not baked.
        complete: false for a bake that was stopped early.
        provenance: command, resolved settings, seed, hashes of model and mesh, device, credits.
        error_vs_time: float64 [rows,3]: seconds, evaluations, estimated relative error.
        selftest: light [K,3], vertex [S], outgoing [S,3] and radiance [S,3], for importers to reproduce; may be empty.
            Of lobes: sun [3] and lobes [S,3], what they add.
        storage: type of the coefficients in a file, "float16" or "float32".
        error_covariance: covariance of the errors of each vertex, or None if unknown.
        lobes: what the transport holds beyond the harmonics, or None.

    >>> import trimesh
    >>> import numpy as np
    >>> import prt_bake as prt
    >>> class White:
    ...     def evaluate(self, incident, positions, outgoing):
    ...         return np.full((len(positions), incident.shape[-2], 3), 0.1)
    >>> ball = trimesh.creation.icosphere(subdivisions=0)
    >>> mesh = prt.Mesh(ball.vertices, ball.faces, ball.vertex_normals)
    >>> asset = prt.bake(White(), mesh, rings=1, sectors=4)
    >>> asset.coefficients.shape, asset.quantity, asset.complete
    ((12, 4, 9, 3), 'transfer', True)
    """

    coefficients: Any
    standard_error: NDArray[np.float32]
    valid: NDArray[np.bool_]
    complete: bool = True
    provenance: dict[str, Any] = field(default_factory=dict)
    error_vs_time: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    selftest: dict[str, NDArray[Any]] = field(default_factory=dict)
    storage: Storage = "float16"
    error_covariance: ErrorCovariance | None = None
    lobes: Lobes | None = None

    @property
    def eta(self) -> float:
        """The absolute index of refraction inside, from the provenance; 1 by default."""
        return float(self.provenance.get("eta", 1.0))

    @property
    def roughness(self) -> float | None:
        """The GGX alpha of the surface (the mean of a texture), from the provenance; None if unknown."""
        value = self.provenance.get("roughness", self.provenance.get("model", {}).get("roughness"))
        return None if value is None else float(value)

    @property
    def error(self) -> TotalError:
        """What the network is off, what the bake is off, and both together; `print(asset.error)` is one line."""
        bake = self.provenance.get("estimated_relative_rmse", {}).get("total")
        compression = self.provenance.get("compression", {}).get("added_relative_rmse", 0.0)
        if hasattr(self.coefficients, "added"):
            compression = self.coefficients.added.total
        whole = None if bake is None else math.hypot(bake, compression)
        return TotalError(self.network_error, whole, "walks" in self.provenance)

    def to_pyvista(self, light: Any = None, eye: Any = None) -> "pyvista.PolyData":
        """Return the mesh as `pyvista.PolyData` with the radiance of a light, for notebooks and other plotters.

        Args:
            light: what `prt.shade` takes; or a `prt.Lighting`, a lat-long picture [H,W,3], or the path of a light as
                for `--light`. None is the shipped sky, or the light of an asset made for one light.
            eye: a point [3] in object space or directions to the eye [V,3]; by default that of `prt.fit_camera`.

        Its point arrays are "radiance" float32 [V,3], linear; "rgb" uint8 [V,3], sRGB, the active scalars; and
        "Normals". Vertices that were not baked are black. Draw it with `lighting=False`: the colours hold the light.

        Raises PrtbakeError if PyVista is not installed, and what `prt.shade` and `prt.read_lighting` raise.

        >>> import prt_bake as prt
        >>> asset = prt.read_asset("spot.h5")
        >>> mesh = asset.to_pyvista("sky.hdr", eye=[-1.0, 1.0, -3.0])
        >>> mesh["radiance"].shape == mesh["rgb"].shape == asset.mesh.positions.shape
        True
        >>> mesh.plot(rgb=True, lighting=False, off_screen=True)
        """
        from prt_bake.preview.polydata import to_pyvista

        return to_pyvista(self, light, eye)

    def show(self, light: Any = None, eye: Any = None) -> Any:
        """Show the window of `prtbake view`; in a notebook, return a picture above sliders for the light and the eye.

        Args:
            light: the path of a light as for `--light`, or a `prt.Lighting`; the shipped sky by default.
            eye: the first position of the camera [3]; by default that of `prt.fit_camera`.

        Without `ipywidgets` a notebook shows a picture alone.

        Raises PrtbakeError if PyVista or a display is missing, and what `prt.read_lighting` raises.
        """
        from prt_bake.preview.show import show

        return show(self, light, eye)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file of the coefficients if they are an open dataset; otherwise do nothing."""
        if hasattr(self.coefficients, "file"):
            self.coefficients.file.close()

    __repr__ = summary
