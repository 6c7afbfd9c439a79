"""Counter-based random numbers for the path tracer's kernels.

Every (seed, query, path) has its own stream, so that results depend neither on threads nor on chunks. The n-th number
is mix(start + n·step), with `start` and the odd `step` hashed from the key. `mix` is the finaliser of SplitMix64
(Steele, Lea and Flood 2014, "Fast splittable pseudorandom number generators").
"""

from typing import Any

import numpy as np

from prt_bake.jit.kernel_functions import called_function, inlined_function

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_FIRST = np.uint64(0xBF58476D1CE4E5B9)
_SECOND = np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31, _S11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)
_ONE = np.uint64(1)
_TO_UNIT = 1.0 / 9007199254740992.0


@inlined_function()
def mix(z: Any) -> Any:
    """The SplitMix64 finaliser: a bijection of 64-bit words in which every input bit reaches every output bit."""
    z = (z ^ (z >> _S30)) * _FIRST
    z = (z ^ (z >> _S27)) * _SECOND
    return z ^ (z >> _S31)


@called_function()
def begin_stream(stream: Any, seed: Any, query: Any, path: Any) -> None:
    """Initialise `stream` (uint64 [2]: counter, step) for (seed, query, path)."""
    key = mix(np.uint64(seed) + _GOLDEN)
    key = mix(key + (np.uint64(query) + _ONE) * _GOLDEN)
    key = mix(key ^ (np.uint64(path) * _SECOND + _FIRST))
    stream[0] = key
    stream[1] = mix(key + _GOLDEN) | _ONE


@inlined_function()
def uniform(stream: Any) -> Any:
    """Next number of the stream, uniform in [0, 1), with 53 random bits."""
    stream[0] += stream[1]
    return np.float64(mix(stream[0]) >> _S11) * _TO_UNIT
