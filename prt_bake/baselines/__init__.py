"""The models that the paper compares itself with: NeuMIP and NeRFactor, on the same scenes, walks and minutes.

A baseline is a transport like the neural BSSRDF (`prt_bake.network.model`), so that bakes, pictures and reports take it
unchanged. May import `prt_bake.trainer` and the rooms below it in `pyproject.toml`. Begin with `by_name.py`, which
trains a baseline by its name; `neumip.py` has the first of them.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "by_name": ["BASELINES", "train_baseline"],
        "ceiling": ["lambert_ceiling", "measure_ceiling"],
        "coarse_light": ["coarse_light"],
        "nerfactor": ["NeRFactor"],
        "nerfactor_settings": ["NeRFactorSettings"],
        "neumip": ["NeuMIP"],
        "neumip_settings": ["NeuMIPSettings"],
    },
)
