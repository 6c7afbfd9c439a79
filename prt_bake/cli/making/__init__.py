"""The steps of `prtbake make`: each runs a command, within one time, and is recorded so that it is not done again.

Start at `steps.py`.
"""
