"""Tests of networks; most have an artificial interior, and no mesh."""

import pytest

WITHOUT_MESH = pytest.mark.filterwarnings("ignore:network. it takes normals as input:formats.errors.InputWarning")
"""For tests that take the normals from the grid of the interior."""
