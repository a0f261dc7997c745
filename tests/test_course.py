"""The course of a run in four sentences, from tables whose numbers are known."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from cprl.terminal.course import course_of, in_sentences


def write_run(run, returns, survival, *, random=(280.0, 284.0)):
    """A run of two replicas whose episodes had these returns and lengths, beside random play."""
    (run / "evaluation").mkdir(parents=True)
    for path, harvest, lengths in (
        (run / "episodes.parquet", returns, survival),
        (run / "evaluation" / "random.parquet", random, [800] * len(random)),
    ):
        count = len(harvest)
        both = [np.tile(np.asarray(own, float), 2) for own in (harvest, lengths)]
        columns = {
            "replica": np.repeat([0, 1], count),
            "episode": np.tile(np.arange(count), 2),
            "agent": np.zeros(2 * count, int),
            "return": both[0],
            "collective_return": both[0] + np.repeat([-10.0, 10.0], count) * (path.parent == run),
            "survival_steps": both[1],
        }
        pq.write_table(pa.table(columns), path)
    return run


RISE_AND_FALL = [*[300.0] * 20, *[600.0] * 40, *[200.0] * 40]
LENGTHS = [*[1000.0] * 60, *[450.0] * 40]


def test_the_course_has_the_peak_the_end_and_random_play(tmp_path):
    course = course_of(write_run(tmp_path / "run", RISE_AND_FALL, LENGTHS))
    assert (course.replicas, course.episodes, course.longest_steps) == (2, 100, 1000)
    assert (course.first_return, course.peak_return, course.peak_episode) == (300, 600, 20)
    assert (course.last_return, course.last_survival_steps) == (200, 450)
    assert course.random_return == 282
    assert course.random_error == pytest.approx(np.std([280, 284, 280, 284], ddof=1) / 2)
    assert course.is_tragedy
    assert in_sentences(course) == (
        "The agents began at 300 apples an episode, all together, and reached 600 around episode 25, 2.1 "
        "times the 282 ± 1 of random play. In the last 30 episodes they got 200, 67% below that peak and 29% "
        "less than random play gets. Boards that can last 1000 steps now last 450. Each agent learned to "
        "take what pays now, and all of them, trained, end worse off than agents who never learned: the "
        "tragedy of the commons."
    )


@pytest.mark.parametrize(
    ("returns", "lengths", "ending"),
    [
        (
            [*[300.0] * 20, *[600.0] * 40],
            [1000.0] * 60,
            "better off than agents who never learned: no tragedy",
        ),
        ([*[300.0] * 20, *[600.0] * 40, *[275.0] * 40], LENGTHS, "no better off than agents who never"),
        ([*[300.0] * 20, *[400.0] * 40, *[200.0] * 40], LENGTHS, "no better off than agents who never"),
        (RISE_AND_FALL, [1000.0] * 100, "no better off than agents who never"),
    ],
    ids=["it rises only", "it falls too little", "its peak is low", "boards last"],
)
def test_what_is_no_tragedy_is_called_none(tmp_path, returns, lengths, ending):
    course = course_of(write_run(tmp_path / "run", returns, lengths))
    assert not course.is_tragedy
    assert ending in in_sentences(course)
    assert "the tragedy of the commons" not in in_sentences(course)


def test_a_course_beside_random_play_that_gets_nothing_has_no_shares_of_it(tmp_path):
    course = course_of(write_run(tmp_path / "run", RISE_AND_FALL, LENGTHS, random=(0.0, 0.0)))
    said = in_sentences(course)
    assert "reached 600 around episode 25, where random play gets none. " in said
    assert "they got 200, 67% below that peak. " in said
    assert "better off than agents who never learned: no tragedy" in said


def test_a_course_of_agents_who_never_harvest_is_no_tragedy(tmp_path):
    run = write_run(tmp_path / "run", [0.0] * 40, [1000.0] * 20 + [10.0] * 20, random=(0.0, 0.0))
    path = run / "episodes.parquet"
    table = pq.read_table(path)
    nothing = pa.array(np.zeros(len(table)))
    where = table.column_names.index("collective_return")
    pq.write_table(table.set_column(where, "collective_return", nothing), path)
    course = course_of(run)
    assert not course.is_tragedy
    assert "In the last 30 episodes they got 0. " in in_sentences(course)
    assert "no better off than agents who never learned" in in_sentences(course)


def test_a_game_that_reports_no_harvest_has_no_course(tmp_path):
    run = write_run(tmp_path / "run", RISE_AND_FALL, LENGTHS)
    table = pq.read_table(run / "episodes.parquet").drop_columns(["collective_return"])
    pq.write_table(table, run / "episodes.parquet")
    with pytest.raises(ValueError, match="lack collective_return"):
        course_of(run)
