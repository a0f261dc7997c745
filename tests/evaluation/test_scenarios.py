"""Stored runs play among named backgrounds, and the numbers are those worked by hand."""

from dataclasses import replace

import pytest
from boards import module_at
from places import ROOT
from stored_runs import CORRIDORS, DQN, MEADOW, SEED, ran, returns

import cprl
from cprl import Experiment, Fresh, maps, presets
from cprl.evaluation import Scenario, run_scenarios, scenario_advantages, scenarios as module, scenarios_of
from cprl.evaluation.populations import agents_of, play_fresh, scripted_agent
from cprl.evaluation.scenarios import scenario_tables
from cprl.measuring.table import where
from cprl.population import Frozen, Learning, Scripted
from cprl.runs.recipe import read_recipe

THREE_CORRIDORS = replace(
    CORRIDORS,
    map=maps.parse(
        """
        >A.A.
        #####
        #AAA<
        #####
        >A...
        """
    ),
)
"""Greedy agents bite 2, 3 and 1 apples, each in its own corridor; sustainable ones none."""


@pytest.fixture(scope="module")
def runs(alike, tmp_path_factory):
    """Runs of scripted agents in three corridors, two replicas, and two DQN agents on the meadow, three."""
    folder = tmp_path_factory.mktemp("scenarios")
    by_script = {
        name: ran(folder / name, THREE_CORRIDORS, [Scripted(name)] * 3, replicas=2)
        for name in ("greedy", "sustainable")
    }
    return {**by_script, "learned": alike}


DOCS = ROOT / "docs"
FRESH = Fresh(replicas=(0, 1, 2), episodes=2, seed=SEED)
BY = ("scenario", "focal")
RETURNS = ("focal/return", "background/return")


@pytest.mark.integration
def test_scores_are_those_worked_by_hand(runs):
    table = run_scenarios(runs["greedy"], Fresh(episodes=2))
    assert table["scenario"].unique().to_pylist() == [
        f"{focal}_among_{background}"
        for background in ("greedy", "sustainable")
        for focal in ("majority", "minority")
    ]
    # The focal agents are 1 and 2, 0 and 2, 0 and 1: ((3 + 1) / 2 + (2 + 1) / 2 + (2 + 3) / 2) / 3 = 2, and
    # all together 4, 3 and 5. As a minority they get 2, 3 and 1.
    for name, together in (("majority_among_sustainable", 4), ("minority_among_sustainable", 2)):
        levels = cprl.estimates(table, [*RETURNS, "collective_return"], by=BY).of(name, "run")
        assert [levels[number].value for number in RETURNS] == [2, 0]
        assert levels["collective_return"].value == pytest.approx(together)
        assert levels["focal/return"].episodes == 2 * 2 * 3, "replicas, episodes, placements"
        assert levels["focal/return"].replicas == 2
    levels = cprl.estimates(table, RETURNS, by=BY)
    assert levels["minority_among_greedy", "run", "background/return"].value == 2


def test_a_run_is_held_against_others_in_its_place(runs):
    name = "minority_among_greedy"
    table = run_scenarios(runs["sustainable"], Fresh(episodes=1))
    # Sustainable agents get nothing, greedy ones in their place 2 on average; the others have corridors of
    # their own, and get (3 + 1) / 2, (2 + 1) / 2 and (2 + 3) / 2 in either case.
    found = scenario_advantages(table)
    ahead = found[name, "greedy", "focal/return"]
    assert (ahead.value, ahead.low, ahead.high, ahead.replicas) == (-2, -2, -2, 2)
    assert found[name, "greedy", "background/return"].value == 0
    levels = cprl.estimates(table, RETURNS, by=BY)
    assert levels[name, "greedy", "focal/return"].value == 2
    assert levels[name, "random", "focal/return"].value == -found[name, "random", "focal/return"].value


def test_a_stored_background_is_of_the_next_replica(runs):
    learned = runs["learned"]
    background = tuple(Frozen(str(learned), agent, replica=None) for agent in range(2))
    own = Scenario(name="its_like", game=MEADOW, focal="minority", background=background)
    table = run_scenarios(learned, FRESH, scenarios=[own])
    run = cprl.load(learned)
    mine, theirs = agents_of(run), agents_of(run, {0: 1, 1: 2, 2: 0})
    for focal, agents in ((0, [mine[0], theirs[1]]), (1, [theirs[0], mine[1]])):
        at_index = {"focal": "run", "focal_agents": str(focal)}
        assert returns(table, **at_index) == returns(play_fresh(FRESH, run, agents))
        one = run_scenarios(learned, replace(FRESH, replicas=(2,)), scenarios=[own])
        assert returns(one, **at_index) == {2: returns(table, **at_index)[2]}, "alone as among all"
    # Random agents in its place meet the same background of the same replica.
    expected = play_fresh(FRESH, run, [scripted_agent("random"), theirs[1]])
    assert returns(table, focal="random", focal_agents="0") == returns(expected)


def keeping(run, *replicas):
    lanes = {f"replica_{number}" for number in replicas}
    kept = {lane: own for lane, own in run.networks.items() if lane.split("/")[0] in lanes}
    return replace(run, networks=kept)


def test_where_replicas_are_missing_the_next_one_that_is_kept_is_the_background(runs):
    run = keeping(cprl.load(runs["learned"]), 1, 2)
    assert [module._next_replica(run, replica) for replica in (0, 1, 2, 3)] == [2, 2, 1, 1]


def test_a_run_of_a_single_replica_is_not_its_own_background(runs, monkeypatch):
    run = cprl.load(runs["learned"])
    monkeypatch.setattr(module, "load", lambda path: keeping(run, 1))
    background = tuple(Frozen(str(run.path), agent, replica=None) for agent in range(2))
    own = Scenario(name="itself", game=MEADOW, focal="minority", background=background)
    answer = "the background .*alike keeps the single replica 1"
    with pytest.raises(ValueError, match=answer):
        run_scenarios(keeping(run, 1), Fresh(episodes=1), scenarios=[own])
    assert len(run_scenarios(run, Fresh(episodes=1, replicas=(0,)), scenarios=[own])), "another replica"
    asked = replace(own, background=tuple(replace(spec, replica=1) for spec in background))
    assert len(run_scenarios(keeping(run, 1), Fresh(episodes=1), scenarios=[asked])), "asked for"


def test_two_agents_have_minorities_alone_and_without_a_beam_no_background_that_fires():
    assert [one.name for one in scenarios_of(CORRIDORS)] == [
        "minority_among_greedy",
        "minority_among_sustainable",
    ]
    assert [one.name.partition("_among_")[2] for one in scenarios_of(MEADOW)] == list(module.SCRIPTED)
    four = scenarios_of(presets.game("commons"))
    assert [one.name for one in four][:2] == ["majority_among_greedy", "minority_among_greedy"]
    assert len(four) == 2 * 5


@pytest.mark.parametrize("name", [name for *_, name in module._COMMITTED])
def test_committed_populations_are_backgrounds_on_their_own_game(name):
    folder = module.results_folder() / name
    experiment = Experiment.from_recipe(read_recipe(folder), directory=folder)
    assert module.stored_for(experiment.game) == folder
    assert all(isinstance(spec, Learning) for spec in experiment.agents)
    assert scenarios_of(experiment.game)[-1].background == tuple(
        Frozen(str(folder), agent, replica=None) for agent in range(experiment.game.agents)
    )


def test_without_a_checkout_stored_backgrounds_are_left_out_and_named(tmp_path, monkeypatch):
    game = presets.game("two_complex", variant="as_run")
    assert module.left_out_of(game) == module.left_out_of(MEADOW) == ""
    monkeypatch.setattr(module, "results_folder", lambda: tmp_path)
    assert [one.name for one in scenarios_of(game)][-1] == "minority_among_aggressive"
    why = rf"minority_among_dqn: the stored population {tmp_path}/two_complex comes with a checkout of cprl"
    assert module.left_out_of(game).startswith(why)


def test_the_table_and_the_estimates_hold_every_number(runs):
    table = run_scenarios(runs["greedy"], Fresh(episodes=2), scenarios=["minority_among_sustainable"])
    assert len(table) == 3 * 3 * 2 * 2 * 3, "who is focal, placements, replicas, episodes, agents"
    own = where(table, focal="run", focal_agents="1", episode=0, agent=1).to_pylist()
    assert [(row["replica"], row["role"], row["return"]) for row in own] == [
        (0, "focal", 3.0),
        (1, "focal", 3.0),
    ]
    baseline = module_at(DOCS / "scenarios_baseline.py")
    rows = {(row["focal"], row["metric"]): row for row in baseline.estimates_of(table).to_pylist()}
    assert rows["run", "focal/return"] == {
        "scenario": "minority_among_sustainable",
        "focal": "run",
        "metric": "focal/return",
        "value": 2.0,
        "low": 2.0,
        "high": 2.0,
        "replicas": 2,
        "episodes": 12,
        "undefined": 0,
    }
    assert rows["greedy", "focal/advantage"]["value"] == 0
    # A single agent of three harvests: 1 - (4 x its harvest) / (2 x 3 x its harvest).
    assert rows["run", "equality"]["value"] == pytest.approx(1 / 3)
    shown = [str(cells.rows[0][1]) for cells in scenario_tables(table)]
    assert shown == ["2.00 [2.00, 2.00]"] * 2


@pytest.mark.parametrize(
    ("given", "answer"),
    [
        ({"name": "among wolves"}, "Scenario.name is 'among wolves'"),
        ({"game": 3}, "Scenario.game is 3"),
        ({"focal": "half"}, "Scenario.focal is 'half'"),
        ({"background": (DQN,) * 2}, "Scenario.background"),
        ({"background": (Scripted("greedy"),)}, "Scenario.background is"),
        ({"game": presets.game("single_basic")}, "Scenario.game has 1 agent"),
    ],
)
def test_odd_scenarios_are_refused(given, answer):
    how = {"name": "own", "game": MEADOW, "focal": "minority", "background": (Scripted("greedy"),) * 2}
    with pytest.raises(ValueError, match=answer):
        Scenario(**{**how, **given})


def test_the_tables_have_the_numbers_of_the_committed_estimates():
    baseline = module_at(DOCS / "scenarios_baseline.py")
    tables = (baseline.OUT / "table.md").read_text()
    played = sorted(path.stem for path in baseline.OUT.glob("*.csv"))
    assert played
    assert set(played) <= set(baseline.POPULATIONS)
    for name in played:
        assert baseline.table(name) in tables, name


def test_every_agent_is_focal_equally_often():
    how = {"name": "own", "game": THREE_CORRIDORS, "background": (Scripted("greedy"),) * 3}
    assert Scenario(focal="minority", **how).placements == [(0,), (1,), (2,)]
    assert Scenario(focal="majority", **how).placements == [(1, 2), (0, 2), (0, 1)]
