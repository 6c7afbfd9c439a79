"""What one runs first: the commands that give a newcomer files to begin with.

May import: every room but the other commands. Start at `example.py`.
"""
