"""A network's own lobes as Gaussians: what it evaluates to beyond the bands of its lobes."""

from dataclasses import replace

import numpy as np
import torch

import prt_bake as prt
from formats.mesh import build_mesh
from prt_bake.mathematics import sh
from prt_bake.mathematics import sphere as sphere_frames
from prt_bake.mathematics.directions import fibonacci
from prt_bake.network.bssrdf import NeuralBSSRDF
from tests.network.test_lobes import LOBED, glass_ball, lobed
from tests.shapes import ball


def network(lobes: int) -> NeuralBSSRDF:
    torch.manual_seed(1)
    box = (-1.0, -1.0, -1.0), 2.0
    return NeuralBSSRDF(replace(LOBED, lobes=lobes), *box, interior=glass_ball(1.4)).on(ball(1))


def test_own_lobes_are_what_the_smooth_network_lacks() -> None:
    lobed, mesh, towards = network(3), ball(1), fibonacci(4000)
    positions, outgoing = mesh.positions[:5], mesh.normals[:5]
    whole, smooth = (part.evaluate(towards, positions, outgoing) for part in (lobed, lobed.smooth(2)))
    found = lobed.own_lobes(positions, outgoing)
    assert found is not None
    axes, sharpness, powers = found
    np.testing.assert_allclose(np.linalg.norm(axes, axis=2), 1.0, atol=1e-5)
    peak = sharpness / (2.0 * np.pi * -np.expm1(-2.0 * sharpness))
    cosines = np.einsum("nji,di->ndj", axes, towards)
    gaussians = peak[:, None] * np.exp(sharpness[:, None] * (cosines - 1.0))
    basis = np.linalg.qr(sh.evaluate(towards, 2))[0]
    gaussians -= np.einsum("dk,ek,nej->ndj", basis, basis, gaussians, optimize=True)
    expected = np.einsum("ndj,njc->ndc", gaussians, powers)
    difference = np.asarray(whole, np.float64) - np.asarray(smooth, np.float64)
    assert np.abs(difference - expected).max() <= 2e-3 * np.abs(expected).max()


def test_a_network_without_lobes_has_none() -> None:
    mesh = ball(1)
    assert network(0).own_lobes(mesh.positions[:2], mesh.normals[:2]) is None


def test_a_bake_takes_the_lobes_of_its_network() -> None:
    sphere = ball(1)
    mesh = build_mesh(0.5 + 0.45 * np.asarray(sphere.positions), np.asarray(sphere.faces))
    asset = prt.bake(lobed(), mesh, rings=16, sectors=32, samples=24, lobes=4)
    assert asset.lobes is not None
    assert asset.lobes.count >= 3
    node = asset.lobes.sectors + 1  # in the second ring, above the horizon of all faces
    local = sphere_frames.view_bins(asset.lobes.rings, asset.lobes.sectors)[node]
    towards = sphere_frames.to_world(local, mesh.normals, np.asarray(asset.tangents, np.float64))
    found = lobed().on(mesh).own_lobes(mesh.positions, towards)
    assert found is not None
    for stored, expected in zip((asset.lobes.axes, asset.lobes.sharpness, asset.lobes.powers), found, strict=True):
        half = np.spacing(np.abs(expected).astype(np.float16)).astype(np.float64) / 2  # rounding of the file's numbers
        assert (np.abs(stored[:, node, :3] - expected) <= 1e-4 * np.abs(expected).max() + half).all()
