"""How the functions inside the walk's loops are compiled.

None of them allocates, so numba's reference counting is left out: every slice of the walker's state would cost two
atomic operations, on counters that all threads share. The walk is more than twice as fast without.
"""

from functools import partial

from prt_bake.compilation import compiled

walk_function = partial(compiled, _nrt=False)
"""Decorator, called with no argument or with numba's own; for functions that make no array."""
