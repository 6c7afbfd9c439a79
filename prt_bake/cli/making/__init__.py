"""`prtbake make`: its steps run other commands, within one time, and are recorded so that they are not done again.

May import: every room but the other commands, and `start`. Start at `make.py`.
"""
