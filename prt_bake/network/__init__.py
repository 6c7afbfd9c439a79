"""The neural BSSRDF: model, settings and checkpoint.

`features` computes the inputs of the network. `inference` evaluates a frozen network fast on CPU and GPU. `core.py` is
the torch module of the layers; `bssrdf.py` adds the frozen forms and the files to it. May import:
`prt_bake.geometry`, `prt_bake.mathematics`, `prt_bake.jit` and `formats`. Begin with `bssrdf.py`. Names load when they
are used, so that `settings` loads without torch.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "bssrdf": ["NeuralBSSRDF", "load_model", "save_model"],
        "settings": ["NetworkSettings"],
    },
)
