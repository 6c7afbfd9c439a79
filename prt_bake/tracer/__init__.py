"""The reference path tracer: estimates of the transport function Ŝ by random walks inside the object.

`volume` samples flights and transmittances in media, `surface` handles interfaces and hits. May import:
`prt_bake.geometry`, `prt_bake.mathematics`, `prt_bake.jit` and `formats`. Begin with `estimate.py`, then `walk.py`.
"""

from prt_bake.tracer.estimate import Estimate, estimate_coefficients, estimate_transport

__all__ = ["Estimate", "estimate_coefficients", "estimate_transport"]
