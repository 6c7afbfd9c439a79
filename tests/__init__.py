"""The tests, in the rooms of what they test; what a room's tests share lies beside them."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
"""The repository."""
