"""Highlights between the view bins that a bake evaluates first."""

import numpy as np
import pytest

from bakers.adaptive.view_levels import view_levels
from bakers.adaptive.view_survey import FULL_LEVELS, ViewSurvey
from prt_bake import bake
from prt_bake.baking.adaptive import survey
from prt_bake.mathematics import sphere
from prt_bake.mathematics.random import uniforms
from tests.bakers.transports import Array, Counting, Lobed, exact, icosphere

BINS = sphere.view_bins(16, 64)
LEVELS = view_levels(BINS)


class Glinting:
    """A cosine, a hundred times as bright within a cone of `bins` bins.

    The cone's direction varies by vertex, and half of the vertices have none.
    """

    def __init__(self, bins: float) -> None:
        self.least = np.cos(np.sqrt(2.0 * bins / len(BINS)))

    def evaluate(self, incident: Array, positions: Array, outgoing: Array) -> Array:
        cosine = np.maximum(np.einsum("ndi,ni->nd", incident, positions), 0.0) + 0.2
        key = np.round(positions * 1e6).astype(np.int64)
        numbers = uniforms((1, key[:, 0], key[:, 1], key[:, 2]), 3)
        radius, around = np.sqrt(0.1 + 0.7 * numbers[:, 0]), 2.0 * np.pi * numbers[:, 1]
        local = np.stack([radius * np.cos(around), radius * np.sin(around), np.sqrt(1.0 - radius**2)], axis=-1)
        axis = sphere.to_world(local, positions, sphere.tangent_frame(positions))
        glints = ((outgoing * axis).sum(axis=-1) > self.least) & (numbers[:, 2] < 0.5)
        return (cosine * np.where(glints, 100.0, 1.0)[:, None])[..., None] * np.array([1.0, 0.8, 0.5])


def spot(bins: int) -> Array:
    """1 everywhere, 100 at the bins that are nearest to a direction."""
    cosine = BINS @ np.array([0.6, 0.0, 0.8])
    return np.where(np.argsort(np.argsort(-cosine)) < bins, 100.0, 1.0)[:, None, None]


@pytest.mark.parametrize("view", [np.zeros(1024), np.ones(1024), 2.0 + BINS[:, 0], np.exp(3.0 * BINS[:, 1])])
def test_smooth_views_need_few_levels(view: Array) -> None:
    survey = ViewSurvey.of(LEVELS, BINS, view[:, None, None], 1e-3)
    assert survey.full_levels_for(0.01, 0.02) == FULL_LEVELS


@pytest.mark.parametrize("bins", [1, 2, 4])
def test_a_highlight_of_a_few_bins_needs_all_levels(bins: int) -> None:
    survey = ViewSurvey.of(LEVELS, BINS, spot(bins), 1e-3)
    assert survey.full_levels_for(0.01, 0.02) == len(LEVELS) - 1


def test_wider_highlights_need_fewer_levels() -> None:
    needed = [ViewSurvey.of(LEVELS, BINS, spot(bins), 1e-3).full_levels_for(0.01, 0.02) for bins in (1, 12, 60, 300)]
    assert needed == sorted(needed, reverse=True)
    assert needed[0] > needed[-1]


def test_tolerated_highlights_need_few_levels() -> None:
    survey = ViewSurvey.of(LEVELS, BINS, 1.0 + 1e-4 * spot(4), 1e-3)
    assert survey.full_levels_for(0.01, 0.02) == FULL_LEVELS


@pytest.mark.statistics
@pytest.mark.parametrize("bins", [6.0, 20.0])
def test_isolated_highlights_are_found_and_reported(bins: float) -> None:
    mesh, transport = icosphere(1), Glinting(bins)
    asset = bake(transport, mesh, error=0.02)
    truth = exact(transport, mesh, 16, 64, directions=512)
    off = np.sqrt(((asset.coefficients - truth) ** 2).sum() / (truth**2).sum())
    assert off <= 1.1 * 0.02
    assert off <= 2.0 * asset.provenance["estimated_relative_rmse"]["total"] + 0.005


def test_few_bins_are_not_surveyed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(survey, "ViewSurvey", None)  # a survey would call it
    with pytest.raises(AttributeError):
        bake(Lobed(), icosphere(1), rings=8, sectors=32, error=0.05)
    counted = Counting(Lobed())
    asset = bake(counted, icosphere(1), rings=2, sectors=8, error=0.05)
    assert asset.provenance["evaluations"] == counted.evaluations
