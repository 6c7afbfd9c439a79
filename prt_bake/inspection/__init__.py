"""`prtbake info` and `prtbake check`: describes files and finds their faults. One module per kind of file.

May import: every room but `trainer.report`, `paper`, `preview`, `shipped` and `cli`. Start at `files.py`.
"""

from prt_bake.inspection.files import describe, find_faults, find_remarks, kind_of
from prt_bake.inspection.overview import overview

__all__ = ["describe", "find_faults", "find_remarks", "kind_of", "overview"]
