"""The course of a run in four sentences, from tables whose numbers are known."""

import runpy
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

TRAGEDY = runpy.run_path(str(Path(__file__).parents[1] / "recipes" / "tragedy.py"))
RISE_AND_FALL = [*[300.0] * 20, *[600.0] * 40, *[200.0] * 40]
NO_BETTER = "no better off than agents who never learned."
LENGTHS = [*[1000.0] * 60, *[450.0] * 40]


def told_of(run, returns, survival, *, random=(280.0, 284.0), lacks=""):
    """The sentences on two replicas whose episodes had these returns, on average, and lengths, beside random
    play."""
    (run / "evaluation").mkdir(parents=True)
    for path, harvest, lengths, spread in (
        (run / "episodes.parquet", returns, survival, 10.0),
        (run / "evaluation" / "random.parquet", random, [800.0] * 2, 0.0),
    ):
        both = np.concatenate([np.array(harvest) - spread, np.array(harvest) + spread])
        columns = {
            "replica": np.repeat([0, 1], len(harvest)),
            "episode": np.tile(np.arange(len(harvest)), 2),
            "agent": np.zeros(2 * len(harvest), int),
            "return": both,
            "collective_return": both,
            "survival_steps": np.tile(np.array(lengths), 2),
        }
        columns.pop(lacks, None)
        pq.write_table(pa.table(columns), path)
    return TRAGEDY["course_of"](run)


def test_the_course_has_the_peak_the_end_and_random_play(tmp_path):
    # The standard error of 280, 284, 280, 284 is 1.15.
    assert told_of(tmp_path / "run", RISE_AND_FALL, LENGTHS) == (
        "The agents began at 300 apples an episode, all together, and reached 600 around episode 25, 2.1 "
        "times the 282 ± 1 of random play. In the last 30 episodes they got 200, 67% below that peak and 29% "
        "less than random play gets. Boards that can last 1000 steps now last 450. Each agent learned to "
        "take what pays now, and all of them, trained, end worse off than agents who never learned: the "
        "tragedy of the commons."
    )


def test_the_peak_of_a_short_run_is_one_of_its_episodes(tmp_path):
    assert "around episode 2," in told_of(tmp_path / "run", [300.0, 310.0], [1000.0] * 2)


@pytest.mark.parametrize(
    ("returns", "lengths", "ending"),
    [
        (RISE_AND_FALL[:60], LENGTHS[:60], "better off than agents who never learned: no tragedy so far."),
        ([*RISE_AND_FALL[:60], *[275.0] * 40], LENGTHS, NO_BETTER),
        ([*[300.0] * 20, *[400.0] * 40, *[200.0] * 40], LENGTHS, NO_BETTER),
        (RISE_AND_FALL, [1000.0] * 100, NO_BETTER),
    ],
    ids=["it rises only", "it falls too little", "its peak is low", "boards last"],
)
def test_what_is_no_tragedy_is_called_none(tmp_path, returns, lengths, ending):
    assert told_of(tmp_path / "run", returns, lengths).endswith(ending)


def test_of_nothing_there_are_no_shares(tmp_path):
    said = told_of(tmp_path / "trained", RISE_AND_FALL, LENGTHS, random=(0.0, 0.0))
    assert "600 around episode 25, where random play gets none. " in said
    assert "they got 200, 67% below that peak. " in said
    idle = told_of(tmp_path / "idle", [0.0] * 40, [1000.0] * 20 + [10.0] * 20, random=(0.0, 0.0))
    assert "In the last 30 episodes they got 0. " in idle


def test_a_game_that_reports_no_harvest_has_no_course(tmp_path):
    with pytest.raises(ValueError, match="lack collective_return"):
        told_of(tmp_path / "run", RISE_AND_FALL, LENGTHS, lacks="collective_return")
