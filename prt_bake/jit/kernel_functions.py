"""Decorators for functions that kernels call, without numba's reference counting.

None of these functions allocates. With reference counting every slice of the walker's state would cost two atomic
operations on counters that all threads share, and the walk would take 2.4 to 2.6 times as long. numba has no public
option for this; `_nrt` is the same from 0.60 to 0.68.

Every call passes the tables of `Boundary` and `Media` by value, some hundred words, which costs more than the work of
most functions. Inlining them makes the walk faster by a third to a half. Functions that are long, rarely called or
called from many places are not inlined, to save compile time. LLVM inlines once per kernel; numba's own option
(`inline="always"`) would type and lower a function again at every call.
"""

from functools import partial

from prt_bake.jit.compilation import compiled

called_function = partial(compiled, _nrt=False)
"""Decorator, called without arguments or with numba's options; for functions that create no array."""
inlined_function = partial(called_function, forceinline=True)
"""As `called_function`, for functions that are inlined wherever they are called."""
