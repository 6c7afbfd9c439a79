"""Networks of other programs: TorchScript and ONNX files that map 7 numbers to 3.

`convention.py` says what the 7 numbers are, `transport.py` makes a file a transport. May import:
`prt_bake.mathematics` and `formats`. Begin with `transport.py`. Names load when they are used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "convention": ["Convention"],
        "transport": ["FunctionTransport", "load_function"],
    },
)
