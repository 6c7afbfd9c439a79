"""`prtbake info` and `prtbake check`: what a file holds, and whether it is sound.

May import: every room but `trainer.report`, `paper`, `preview`, `shipped` and `cli`. Begin with `files.py`.
"""
