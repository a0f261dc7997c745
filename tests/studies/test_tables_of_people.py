"""Tables that put people beside trained agents: groups are replicas, rounds of a session pairs."""

from dataclasses import replace
from statistics import fmean

import pytest
from hosted_runs import begun, hosted
from stored_runs import command
from study_runs import EXPERIMENT, write_run

from cprl import Rules
from cprl.institutions import Tax
from cprl.measuring.table import where
from cprl.runs.episodes import read_episodes
from cprl.studies.tables.comparing import comparison_tables, condition_means, episodes_text
from cprl.studies.tables.pooled import pooled_table
from cprl.studies.tables.tidy_table import EVALUATION_PART, RANDOM_PART

BOARD = replace(EXPERIMENT.game, rules=Rules(freeze_steps=5, episode_steps=30))
TAXED = replace(BOARD, institutions=(Tax(rate=0.5),))
RETURN = "collective_return"


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """Two rounds without a rule and one with a tax, of the same three groups."""
    folder = tmp_path_factory.mktemp("session")
    for number, game in enumerate((BOARD, TAXED, BOARD), start=1):
        hosted(folder / f"round-{number}", game, session="monday", seed=number, chance=number)
    return folder


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Agents that harvest 8 apples while they learn and 9 in fresh worlds, with the seed of a round."""
    run = tmp_path_factory.mktemp("runs") / "trained"
    write_run(run, replace(EXPERIMENT, game=BOARD, seed=1), lambda _, number: 9.0 if number < 0 else 8.0)
    return run


def apples(run):
    return where(read_episodes(run), agent=0)[RETURN].to_pylist()


def test_rounds_of_a_session_are_episodes_of_its_groups_and_conditions_are_paired_by_group(session):
    table = pooled_table([session], by=["game.institutions"])
    assert table.design.is_paired
    assert [*table.replicas.values()] == [3, 3]
    first, second = apples(session / "round-1"), apples(session / "round-3")
    by_group = [fmean(pair) for pair in zip(first, second, strict=True)]
    means = condition_means(table, [RETURN])
    no_rule = means["institutions=()", RETURN]
    assert no_rule.value == pytest.approx(fmean(by_group))
    assert no_rule.replicas == 3
    assert episodes_text(table) == "the episodes that people played"


def test_the_same_seed_in_two_sessions_is_of_other_people_and_not_paired(session, tmp_path):
    other = hosted(tmp_path / "other", TAXED, session="tuesday", seed=1)
    table = pooled_table([session / "round-1", other], by=["game.institutions"])
    assert not table.design.is_paired
    alone = [hosted(tmp_path / name, BOARD, seed=1) for name in ("one", "two")]
    assert [*pooled_table(alone, by=["game.map"]).replicas.values()] == [6]


def test_people_stand_beside_trained_agents_without_a_field_being_named(
    session, trained, monkeypatch, capsys
):
    printed = command(monkeypatch, capsys, "table", session / "round-1", trained)
    assert "agents=2 people" in printed
    assert "agents=2 agents by DQN" in printed
    assert "The last 30 episodes of training and the episodes that people played; means" in printed
    assert "not paired" in printed


def test_people_and_agents_are_never_pooled(session, trained):
    table = pooled_table([session, trained], by=["game.institutions"])
    no_rule = "institutions=(), agents=2 "
    assert {f"{no_rule}people": 3, f"{no_rule}agents by DQN": 2}.items() <= table.replicas.items()
    assert table.replicas.keys() - table.hosted_conditions == {f"{no_rule}agents by DQN"}


def test_people_stand_beside_agents_in_fresh_worlds_and_nobody_beside_random_play(session, trained):
    table = pooled_table([session / "round-1", trained], by=["agents"])
    people = "agents=2 people"
    assert table.hosted_conditions == (people,)
    fresh = condition_means(table, [RETURN], part=EVALUATION_PART)
    assert fresh[people, RETURN].value == pytest.approx(fmean(apples(session / "round-1")))
    assert fresh["agents=2 agents by DQN", RETURN].value == 9
    assert "people" not in episodes_text(table, RANDOM_PART)
    (means, _) = comparison_tables(table, [RETURN], part=RANDOM_PART)
    assert "people" not in means.heading
    of_people = pooled_table([session], by=["game.institutions"])
    (means, _) = comparison_tables(of_people, [RETURN], part=RANDOM_PART)
    assert means.heading.startswith("No episodes; ")


def test_a_round_that_is_not_over_is_named_and_no_part_of_a_table(session, tmp_path):
    run, _ = begun(tmp_path / "begun", TAXED)
    table = pooled_table([session / "round-1", run], by=["game.institutions"])
    assert [missing.reason for missing in table.missing_runs] == ["has not ended"]


def test_a_table_that_was_read_again_says_people_too(session, tmp_path):
    table = pooled_table([session], by=["game.institutions"])
    again = type(table).read(table.write(tmp_path / "table.parquet"))
    assert episodes_text(again) == episodes_text(table)
