"""The public functions as callers get them: arguments of the wrong kind are refused by name, signatures are short.

Works on the functions that `prt_bake` hands out, so that the modules behind them need no checks of types. May import:
`formats`. Begin with `public.py`; `kinds.py` says which kind each argument has.
"""
