"""Bakes to an error that is asked for, or for as long as one likes.

`run` goes through the passes, `first_look` and `aim` find out how to, `passes` does one, `nearby` foretells vertices.
"""
