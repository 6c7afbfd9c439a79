"""Pictures of σ, the width that the importance module gives the lobe of each point seen: a figure of the paper."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from formats.atomic import replacing
from formats.mesh import Mesh
from prt_bake.geometry.camera import Camera, Visibility, directions
from prt_bake.importance.module import load_importance
from prt_bake.paper.sheet import CELL, INK, PAPER, coloured, fitted

_SCALE, _LABEL, _GAP = 14, 18, 6


@dataclass(frozen=True)
class SigmaPicture:
    """σ in degrees [H,W] of the points seen in the middle of each pixel, nan off the object, and the scene's name."""

    title: str
    degrees: NDArray[np.float64]


def sigma_picture(title: str, model_path: Path, mesh: Mesh, view: Camera) -> SigmaPicture:
    """Ask the importance module beside a model; of several lobes the mean is taken."""
    pixels, positions, outgoing = _seen_points(mesh, view)
    sigma = np.degrees(load_importance(model_path).sigma(positions, outgoing)).reshape(len(pixels), -1).mean(axis=1)
    degrees = np.full(view.height * view.width, np.nan)
    degrees[pixels] = sigma
    return SigmaPicture(title, degrees.reshape(view.height, view.width))


def _seen_points(mesh: Mesh, view: Camera) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Pixels [N], row · width + column, positions [N,3] and directions to the eye [N,3] of what the rays through the
    middle of each pixel meet.
    """
    rays = directions(view, slice(0, view.height), np.array([[0.5, 0.5]])).reshape(-1, 3)
    hits = Visibility(mesh).first_hits(view.eye, rays)
    met = np.flatnonzero(hits.faces >= 0)
    u, v = hits.barycentric[met].T
    shares = np.stack([1.0 - u - v, u, v], axis=1)
    return met, np.einsum("nk,nki->ni", shares, mesh.positions[mesh.faces[hits.faces[met]]]), -rays[met]


def write_sigma(path: Path, pictures: Sequence[SigmaPicture]) -> None:
    """Write the pictures side by side as PNG, in viridis from the least to the largest σ, with the scale below."""
    least = min(float(np.nanmin(picture.degrees)) for picture in pictures)
    largest = max(float(np.nanmax(picture.degrees)) for picture in pictures)
    spread = max(largest - least, 1e-3)
    width = len(pictures) * (CELL + _GAP) + _GAP
    sheet = Image.new("RGB", (width, 2 * _LABEL + CELL + _SCALE + 2 * _GAP), PAPER)
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(13)
    for i, picture in enumerate(pictures):
        left = _GAP + i * (CELL + _GAP)
        draw.text((left, 1), picture.title, INK, font)
        colours = coloured(np.nan_to_num(picture.degrees - least), spread, "viridis")
        colours[np.isnan(picture.degrees)] = PAPER
        sheet.paste(fitted(colours), (left, _LABEL))
    ramp = np.tile(np.linspace(0.0, 1.0, width - 2 * _GAP), (_SCALE, 1))
    top = _LABEL + CELL + _GAP
    sheet.paste(Image.fromarray(coloured(ramp, 1.0, "viridis")), (_GAP, top))
    draw.text((_GAP, top + _SCALE), f"sigma {least:.1f}°", INK, font)
    words = f"{largest:.1f}°"
    draw.text((width - _GAP - draw.textlength(words, font), top + _SCALE), words, INK, font)
    with replacing(path) as part:
        sheet.save(part, format="PNG", optimize=True)
