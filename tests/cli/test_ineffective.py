"""Options that would have no effect are refused, so that nobody waits for what they ask for."""

import pytest

from tests.cli.command_line import Run


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("bake scene.toml -o a.h5 --directions sobol", "--directions: has no effect on a scene, which is path traced"),
        ("bake scene.toml -o a.h5 --lobes 2", "--lobes: has no effect on a scene"),
        ("bake scene.toml -o a.h5 --convention incident", "--convention: has no effect on a scene"),
        ("report bake model.pt sphere.ply --points 64", "--points: has no effect without --light"),
        ("report bake model.pt sphere.ply --view left", "--view: has no effect without --light"),
        ("train scene.toml -o a.pt --mend", "--mend: has no effect without --light"),
    ],
)
def test_options_without_effect_are_wrong_usage(prtbake: Run, line: str, sentence: str) -> None:
    outcome = prtbake(*line.split())
    assert outcome.code == 2
    assert sentence in " ".join(outcome.err.split())
