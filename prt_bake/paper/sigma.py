"""Pictures of σ, the width of the importance module's lobe at each visible point: a figure of the paper."""

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
from prt_bake.paper.sheet import CELL, INK, PAPER, coloured, resized

_SCALE, _LABEL, _GAP = 14, 18, 6


@dataclass(frozen=True)
class SigmaPicture:
    """σ in degrees [H,W] at the centre of each pixel, nan off the object, and the scene's name."""

    title: str
    degrees: NDArray[np.float64]


def sigma_picture(title: str, model_path: Path, mesh: Mesh, view: Camera) -> SigmaPicture:
    """Evaluate the importance module of a model; σ is the mean over its lobes."""
    pixels, positions, outgoing = _visible_points(mesh, view)
    sigma = np.degrees(load_importance(model_path).sigma(positions, outgoing)).reshape(len(pixels), -1).mean(axis=1)
    degrees = np.full(view.height * view.width, np.nan)
    degrees[pixels] = sigma
    return SigmaPicture(title, degrees.reshape(view.height, view.width))


def _visible_points(mesh: Mesh, view: Camera) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Return pixels [N] (row · width + column), positions [N,3] and directions to the eye [N,3] at pixel centres."""
    rays = directions(view, slice(0, view.height), np.array([[0.5, 0.5]])).reshape(-1, 3)
    hits = Visibility(mesh).first_hits(view.eye, rays)
    pixels = np.flatnonzero(hits.faces >= 0)
    u, v = hits.barycentric[pixels].T
    weights = np.stack([1.0 - u - v, u, v], axis=1)
    corners = mesh.positions[mesh.faces[hits.faces[pixels]]]
    return pixels, np.einsum("nk,nki->ni", weights, corners), -rays[pixels]


def write_sigma(path: Path, pictures: Sequence[SigmaPicture]) -> None:
    """Write the pictures side by side as PNG, in viridis from the smallest to the largest σ, above the scale."""
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
        sheet.paste(resized(colours), (left, _LABEL))
    ramp = np.tile(np.linspace(0.0, 1.0, width - 2 * _GAP), (_SCALE, 1))
    top = _LABEL + CELL + _GAP
    sheet.paste(Image.fromarray(coloured(ramp, 1.0, "viridis")), (_GAP, top))
    draw.text((_GAP, top + _SCALE), f"sigma {least:.1f}°", INK, font)
    label = f"{largest:.1f}°"
    draw.text((width - _GAP - draw.textlength(label, font), top + _SCALE), label, INK, font)
    with replacing(path) as part:
        sheet.save(part, format="PNG", optimize=True)
