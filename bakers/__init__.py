"""Computes harmonic coefficients from a transport: an object that evaluates Ŝ or estimates coefficients itself.

The mathematics is passed in as arrays and callables, so this package imports only `formats`, NumPy and SciPy.
Begin with the protocols in `transport.py`, then `baker.py`, the bake with a fixed number of samples per bin.
`adaptive/` bakes to a given error.
"""

from bakers.transport import BlockTransport, CoefficientTransport, Transport, WalkBlockTransport

__all__ = ["BlockTransport", "CoefficientTransport", "Transport", "WalkBlockTransport"]
