"""How the functions inside the walk's loops are compiled.

None of them allocates, so numba's reference counting is left out: every slice of the walker's state would cost two
atomic operations, on counters that all threads share. The walk takes 2.4 to 2.6 times as long with it. numba has no
public option for this; `_nrt` is the same from 0.60 to 0.68.

Every call hands over the tables of `Boundary` and `Media` by value, some hundred words, which costs more than what most
functions do: inlining them makes the walk faster by a third to a half. What is long, seldom called or called from many
places stays a call, for the sake of the time that compiling takes. LLVM inlines, once for each kernel: numba's own way
(`inline="always"`) would type and lower a function again wherever it is called.
"""

from functools import partial

from prt_bake.jit.compilation import compiled

called_function = partial(compiled, _nrt=False)
"""Decorator, called with no argument or with numba's own; for functions that make no array."""
walk_function = partial(called_function, forceinline=True)
"""The same for what is inlined wherever it is called."""
