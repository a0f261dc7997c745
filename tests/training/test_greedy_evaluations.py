"""Greedy evaluations while agents are trained: their table, and that the training does not notice."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from own_parts import Dilemma
from recordings import column

import cprl
from cprl import Custom, Game, Rules, maps
from cprl.algorithms import DQN, PPO, VDN, DQNSettings, RolloutSettings, Tabular, TabularSettings
from cprl.commands.recipe_command import parse_command
from cprl.institutions import Tax, Vote
from cprl.measuring.table import where
from cprl.population import Frozen, Learning, Scripted, Team
from cprl.runs.episodes import read_episodes, read_evaluations
from cprl.runs.weights import load_weights
from cprl.terminal.figures import training_curve

REPLAY = DQNSettings(
    buffer_size=100,
    batch_size=4,
    learning_starts=4,
    hidden_cells=(8,),
    learning_rate=1e-2,
    epsilon_hold_steps=9,
)
ROLLOUT = RolloutSettings(rollout_steps=6, minibatch_size=3, hidden_cells=(8,), learning_rate=1e-2)
GAME = Game(
    map=maps.parse(".A>.\n.<v.\n..>A"),
    rules=Rules(regrow_prob=(0.0,), window_rows=3, window_columns=5, episode_steps=60),
)
"""Boards that are empty at different turns in different worlds."""
EVEN = replace(GAME, rules=replace(GAME.rules, regrow_prob=(0.1, 0.1), episode_steps=15))
"""Its episodes have all the same length."""
MIXED = (
    Learning(DQN(settings=REPLAY)),
    Team(VDN(settings=REPLAY), agents=(1, 3)),
    Learning(Tabular(settings=TabularSettings())),
)
DQNS = (Learning(DQN(settings=REPLAY)), Learning(PPO(settings=ROLLOUT)), Scripted("greedy"), Scripted())


def experiment(**changes):
    options = {"replicas": 2, "episodes": 5, "evaluation_episodes": 3, "engine": "eager", "seed": 4}
    options |= {"name": "evaluated", "game": GAME, "agents": MIXED, "evaluate_every": 2}
    return cprl.Experiment(**options | changes)


def run(experiment, out, **options):
    return cprl.run(experiment, out, **{"watch": "off", "keep_checkpoint": True, **options})


def rows(table):
    """Its values, of which NaN equals NaN."""
    return repr(table.to_pydict())


def final_weights(run):
    return repr(load_weights(run / "checkpoints" / "final.pt"))


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory):
    return run(experiment(), tmp_path_factory.mktemp("evaluated") / "run")


@pytest.mark.integration
@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"agents": DQNS, "engine": "torchrl"},
        {"agents": DQNS[:2], "game": Dilemma(steps=5)},
        {"agents": DQNS, "game": replace(GAME, institutions=(Vote(on=Tax(rate=0.5)),))},
        pytest.param({"agents": DQNS, "engine": "compiled"}, marks=pytest.mark.slow),
    ],
    ids=["mixed", "torchrl", "matrix game", "voting", "compiled"],
)
def test_a_training_is_the_same_bit_for_bit_with_evaluations_and_without(changes, tmp_path):
    with_them = run(experiment(**changes), tmp_path / "with")
    without = run(experiment(**changes, evaluate_every=None), tmp_path / "without")
    assert rows(read_episodes(with_them)) == rows(read_episodes(without))
    assert final_weights(with_them) == final_weights(without)
    assert read_evaluations(without) is None
    table = read_evaluations(with_them)
    agents = len(experiment(**changes).agents) + (changes.get("agents", MIXED) is MIXED)
    assert table.num_rows == 2 * 2 * 3 * agents, "evaluations x replicas x episodes x agents"


def test_the_table_has_a_row_for_each_evaluation_replica_episode_and_agent(evaluated):
    table = read_evaluations(evaluated)
    places = [
        (row["trained_episodes"], row["replica"], row["episode"], row["agent"]) for row in table.to_pylist()
    ]
    assert sorted(places) == list(product((2, 4), range(2), range(3), range(4)))
    assert set(read_episodes(evaluated).column_names) - {"wanted_return", "world"} <= set(table.column_names)


@pytest.mark.integration
def test_a_replica_is_evaluated_as_it_would_be_alone(evaluated, tmp_path):
    alone = read_evaluations(run(experiment(replicas=1), tmp_path / "alone"))
    together = read_evaluations(evaluated)
    assert rows(alone) == rows(together.filter(np.array(together["replica"]) == 0))


@pytest.mark.integration
def test_agents_play_as_a_greedy_evaluation_of_a_run_of_so_many_episodes(tmp_path):
    even = experiment(game=EVEN)
    table = read_evaluations(run(even, tmp_path / "run"))
    short = run(replace(even, episodes=2), tmp_path / "short")
    greedy = cprl.evaluate_run(short, cprl.Fresh(episodes=3, greedy=True, seed=even.seed + 1))
    after_two = where(table, trained_episodes=2).drop(["trained_episodes"])
    assert rows(after_two) == rows(where(greedy, policy="trained").select(after_two.column_names))


@pytest.mark.integration
def test_a_run_that_is_stopped_and_resumed_has_the_same_evaluations(tmp_path, stopped):
    stopping = experiment(callbacks=(Custom("own_parts:Stopping"),))
    whole = run(stopping, tmp_path / "whole")
    steps = sum(
        row["steps"] for row in read_episodes(whole).to_pylist() if (row["replica"], row["agent"]) == (0, 0)
    )
    for stop in (steps // 4, steps // 2):
        stopped(stop, stopping, tmp_path / "parts", resume=(tmp_path / "parts").exists())
    before = read_evaluations(tmp_path / "parts")
    parts = run(stopping, tmp_path / "parts", resume=True)
    assert rows(read_evaluations(parts)) == rows(read_evaluations(whole))
    assert 0 < before.num_rows < read_evaluations(whole).num_rows
    more = replace(stopping, episodes=8)
    longer, long = run(more, parts, resume=True), run(more, tmp_path / "long")
    assert rows(read_evaluations(longer)) == rows(read_evaluations(long))


@pytest.mark.integration
def test_evaluations_are_logged_recorded_and_drawn(tmp_path, monkeypatch):
    log = Custom("torchrl.record.loggers:CSVLogger", arguments={"exp_name": "log", "log_dir": str(tmp_path)})
    stored = run(experiment(loggers=(log,)), tmp_path / "run", watch="file", figures=True)
    table = read_evaluations(stored)
    of_agent = table.filter(np.array(table["agent"]) == 0)
    means = of_agent.group_by("trained_episodes").aggregate([("collective_return", "mean")])
    wanted = means["collective_return_mean"].to_pylist()
    lines = (tmp_path / "log/scalars/evaluation/collective_return.csv").read_text().split()
    assert [line.split(",")[0] for line in lines] == ["1", "3"], "the episodes, counted from 0"
    assert [float(line.split(",")[1]) for line in lines] == pytest.approx(wanted)
    entity = "evaluation/collective_return"
    episodes, values = column(stored / "run.rrd", entity, "Scalars:scalars", "episode")
    assert episodes == [1, 3]
    assert np.ravel(values) == pytest.approx(wanted)
    figures = []
    with monkeypatch.context() as patched:
        patched.setattr("cprl.terminal.style.save", lambda figure, path, **how: figures.append(figure))
        training_curve(stored, title="evaluated")
    panel = next(axes for axes in figures[0].axes if axes.lines)
    (line,) = (line for line in panel.lines if line.get_label() == "greedy, evaluated while trained")
    assert np.column_stack(line.get_data()) == pytest.approx(np.column_stack([[1, 3], wanted]))


@pytest.mark.integration
def test_stored_agents_among_those_that_learn_are_evaluated_too(evaluated, tmp_path, monkeypatch):
    monkeypatch.chdir(evaluated.parent)
    among = experiment(agents=(DQNS[0], Frozen("run", 0), Frozen("run", 1, replica=None), Scripted("greedy")))
    assert read_evaluations(run(among, tmp_path / "among")).num_rows == 2 * 2 * 3 * 4


def test_how_often_is_a_flag_and_at_least_every_episode():
    assert parse_command(experiment, ["recipe.py", "--evaluate-every", "7"])[0].evaluate_every == 7
    with pytest.raises(ValueError, match=r"experiment\.evaluate_every is 0"):
        experiment(evaluate_every=0)
