"""Dielectric interfaces: index-matched, smooth, or rough.

The rough interface is the single-scattering microfacet model of Walter et al. 2007 with the GGX distribution and
separable Smith masking. Visible normals are sampled (Heitz 2018, "Sampling the GGX distribution of visible normals").
`alpha` is the GGX roughness, `eta` the refractive index beyond the interface over that on the side of `i`.

All functions use a local frame whose z axis is the normal on the side of `i`, the direction back along the path. They
omit the squared index ratio: paths begin and end outside, so that the product of all ratios is 1.

`prt_bake.reflection.microfacet` has the same model in NumPy, for light reflected at the points that the eye sees.
"""

import math
from typing import Any

from prt_bake.jit.kernel_functions import called_function, inlined_function
from prt_bake.mathematics.counter import uniform
from prt_bake.mathematics.fresnel import fresnel

MATCHED, SMOOTH, ROUGH = 0, 1, 2


@inlined_function()
def masking(cosine: Any, alpha: Any) -> Any:
    """Smith's masking function G1 of GGX (Walter 2007, eq. 34)."""
    squared = cosine * cosine
    if squared <= 0.0:
        return 0.0
    return 2.0 / (1.0 + math.sqrt(1.0 + alpha * alpha * (1.0 - squared) / squared))


@inlined_function()
def microfacet_distribution(cosine: Any, alpha: Any) -> Any:
    """GGX distribution D (Walter 2007, eq. 33), in a form that is accurate for small alpha."""
    squared = cosine * cosine
    root = (1.0 - squared) + alpha * alpha * squared
    return alpha * alpha / (math.pi * root * root)


@called_function()
def visible_microfacet(ix: Any, iy: Any, iz: Any, alpha: Any, u1: Any, u2: Any) -> Any:
    """Sample a visible normal from `i` (iz > 0) with density G1(i) |i·m| D(m) / iz (Heitz 2018, disc method)."""
    x, y, z = alpha * ix, alpha * iy, iz
    scale = 1.0 / math.sqrt(x * x + y * y + z * z)
    x, y, z = x * scale, y * scale, z * scale
    plane = x * x + y * y
    if plane > 1e-14:
        root = 1.0 / math.sqrt(plane)
        tx, ty = -y * root, x * root
    else:
        tx, ty = 1.0, 0.0
    bx, by, bz = -z * ty, z * tx, x * ty - y * tx
    radius = math.sqrt(u1)
    angle = 2.0 * math.pi * u2
    p = radius * math.cos(angle)
    q = radius * math.sin(angle)
    blend = 0.5 * (1.0 + z)
    q = (1.0 - blend) * math.sqrt(max(0.0, 1.0 - p * p)) + blend * q
    r = math.sqrt(max(0.0, 1.0 - p * p - q * q))
    hx, hy, hz = p * tx + q * bx + r * x, p * ty + q * by + r * y, q * bz + r * z
    mx, my, mz = alpha * hx, alpha * hy, max(1e-9, hz)
    scale = 1.0 / math.sqrt(mx * mx + my * my + mz * mz)
    return mx * scale, my * scale, mz * scale


@inlined_function()
def refract(ix: Any, iy: Any, iz: Any, mx: Any, my: Any, mz: Any, cosine: Any, eta: Any) -> Any:
    """Direction of refraction at a microfacet at `cosine` to i; tangential under total internal reflection."""
    across = math.sqrt(max(0.0, 1.0 - (1.0 - cosine * cosine) / (eta * eta)))
    along = cosine / eta - across
    return along * mx - ix / eta, along * my - iy / eta, along * mz - iz / eta


@called_function()
def sample_interface(
    kind: Any, alpha: Any, eta: Any, ix: Any, iy: Any, iz: Any, transmit_only: Any, stream: Any
) -> Any:
    """Sample the event of an eye path that arrives along −i: (ox, oy, oz, weight), oz < 0 for transmission.

    With `transmit_only`, the first event of a query, the path always crosses and the weight is the transmittance.
    Weight 0 ends the path: single scattering loses what hits a second microfacet.
    """
    if kind == MATCHED:
        return -ix, -iy, -iz, 1.0
    mx, my, mz = 0.0, 0.0, 1.0
    if kind == ROUGH:
        mx, my, mz = visible_microfacet(ix, iy, iz, alpha, uniform(stream), uniform(stream))
    cosine = ix * mx + iy * my + iz * mz
    if cosine <= 0.0:
        return 0.0, 0.0, 1.0, 0.0
    reflectance = fresnel(cosine, eta)
    weight = 1.0
    if transmit_only:
        weight = 1.0 - reflectance
    elif uniform(stream) < reflectance:
        ox, oy, oz = 2.0 * cosine * mx - ix, 2.0 * cosine * my - iy, 2.0 * cosine * mz - iz
        if oz <= 0.0:
            return ox, oy, oz, 0.0
        if kind == ROUGH:
            weight = masking(oz, alpha)
        return ox, oy, oz, weight
    ox, oy, oz = refract(ix, iy, iz, mx, my, mz, cosine, eta)
    if oz >= 0.0:
        return ox, oy, oz, 0.0
    if kind == ROUGH:
        weight *= masking(oz, alpha)
    return ox, oy, oz, weight


@called_function()
def refract_at_microfacet(alpha: Any, eta: Any, ix: Any, iy: Any, iz: Any, u1: Any, u2: Any) -> Any:
    """Sample a direction by refraction at a visible microfacet, density `microfacet_transport`; oz ≥ 0: void sample."""
    mx, my, mz = visible_microfacet(ix, iy, iz, alpha, u1, u2)
    cosine = ix * mx + iy * my + iz * mz
    if cosine <= 0.0 or fresnel(cosine, eta) >= 1.0:
        return 0.0, 0.0, 1.0
    return refract(ix, iy, iz, mx, my, mz, cosine, eta)


@called_function()
def microfacet_transport(alpha: Any, eta: Any, ix: Any, iy: Any, iz: Any, ox: Any, oy: Any, oz: Any) -> Any:
    """Density of o per solid angle, if a visible microfacet sampled from i reflects (oz > 0) or refracts (oz < 0)
    there, and the Fresnel reflectance of that microfacet (Walter 2007, eqs. 38 and 40; Heitz 2018).
    """
    if iz <= 0.0 or oz == 0.0:
        return 0.0, 0.0
    if oz > 0.0:
        hx, hy, hz = ix + ox, iy + oy, iz + oz
    else:
        hx, hy, hz = -(ix + eta * ox), -(iy + eta * oy), -(iz + eta * oz)
    length = math.sqrt(hx * hx + hy * hy + hz * hz)
    if length < 1e-12:
        return 0.0, 0.0
    if hz < 0.0:
        length = -length
    hx, hy, hz = hx / length, hy / length, hz / length
    from_i = ix * hx + iy * hy + iz * hz
    to_o = ox * hx + oy * hy + oz * hz
    if from_i <= 0.0 or to_o * oz <= 0.0:
        return 0.0, 0.0
    visible = microfacet_distribution(hz, alpha) * masking(iz, alpha) / iz
    reflectance = fresnel(from_i, eta)
    if oz > 0.0:
        return 0.25 * visible, reflectance
    root = from_i + eta * to_o
    if root == 0.0:
        return 0.0, 0.0
    return visible * from_i * eta * eta * abs(to_o) / (root * root), reflectance


@called_function()
def rough_density(alpha: Any, eta: Any, ix: Any, iy: Any, iz: Any, ox: Any, oy: Any, oz: Any) -> Any:
    """f(i, o) |o·n| of the rough interface per solid angle of o, for reflection (oz > 0) or transmission (oz < 0).

    It equals the weight of `sample_interface` times its density: Walter 2007, eqs. 20 and 21, without the squared index
    ratio.
    """
    density, reflectance = microfacet_transport(alpha, eta, ix, iy, iz, ox, oy, oz)
    return density * masking(oz, alpha) * (reflectance if oz > 0.0 else 1.0 - reflectance)
