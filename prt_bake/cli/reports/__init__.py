"""The commands `prtbake report bake|bases|training|paper`.

May import: every room but the other commands. Start at `training.py`.
"""
