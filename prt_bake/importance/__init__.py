"""The importance module of the paper: it predicts, for a query (x, ωo), the lobe from which to draw ωi.

May import: `prt_bake.network`, `prt_bake.mathematics`, `bakers` and `formats`. Begin with `module.py`; `fit.py` trains
a module, on `targets.py` and with the loss of `loss.py`.
"""

from prt_bake.importance.module import (
    ImportanceModule,
    importance_path,
    load_importance,
    read_importance,
    save_importance,
)
from prt_bake.importance.settings import IMPORTANCE_PRESETS, ImportanceSettings

__all__ = [
    "IMPORTANCE_PRESETS",
    "ImportanceModule",
    "ImportanceSettings",
    "importance_path",
    "load_importance",
    "read_importance",
    "save_importance",
]
