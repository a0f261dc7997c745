"""Helpers of the tests: small games, runs on them, and commands that read these."""

from small_learners import ALGORITHMS

import cprl
from cprl import Experiment, Game, Rules, maps
from cprl.commands import main as cli
from cprl.measuring.statistics import estimates
from cprl.measuring.table import all_metrics, labels_of, where
from cprl.population import Learning, Scripted
from cprl.runs.recipe import start_run
from cprl.runs.weights import save_weights

CORRIDORS = Game(
    map=maps.parse(
        """
        >A.A.
        #####
        #AAA<
        """
    ),
    rules=Rules(
        regrow_prob=(0.0,), window_rows=4, window_columns=3, episode_steps=9, may_fire=False, freeze_steps=0
    ),
)
"""A greedy agent 0 bites at steps 1 and 3, a greedy agent 1 at steps 1, 2 and 3; nothing grows again, so that
then the episode is over. A sustainable agent leaves them all: near none of them hang three others."""

MEADOW = Game(
    map=maps.parse(
        """
        .A>.A.A
        A.A...A
        ..<.A.A
        """
    ),
    rules=Rules(regrow_prob=(0.0, 0.2), window_rows=3, window_columns=5, episode_steps=15, freeze_steps=2),
)

DQN, PPO, SAC, C51 = (Learning(ALGORITHMS[name]) for name in ("DQN", "PPO", "SAC", "C51"))

cprl.trust("c51:C51", "cql:CQL", "iql:IQL")

SEED = 77


def an_experiment(name, game, members, *, replicas=3):
    return Experiment(
        name=name,
        game=game,
        agents=members,
        replicas=replicas,
        episodes=3,
        seed=3,
        evaluation_episodes=1,
        engine="eager",
    )


def ran(folder, game, members, **how):
    return cprl.run(an_experiment(folder.name, game, members, **how), folder, watch="off")


def stored(folder, game=CORRIDORS, policy="greedy", *, name="", replicas=1, **parts):
    """A run of scripted agents, of which no episode was played; `parts`: more of its experiment."""
    name = name or folder.name
    agents = (Scripted(policy),) * game.agents
    experiment = Experiment(name=name, game=game, agents=agents, replicas=replicas, episodes=1, **parts)
    save_weights(start_run(folder, name, experiment.to_recipe), {})
    return folder


def values(table, numbers=(), **labels):
    """Means over replicas of the rows with these labels, by name; None where undefined in all episodes."""
    rows = where(table, **labels)
    agents = len(rows["agent"].unique())
    names = numbers or [*all_metrics(rows), *(f"agent_{agent}/return" for agent in range(agents))]
    found = estimates(rows, names)
    return {name: one.value if one.replicas else None for (name,), one in found.items()}


def episodes_of(table, column, **labels):
    """What a column holds of the agents of each episode with these labels, by replica."""
    found = {}
    for row in where(table, **labels).to_pylist():
        key = tuple(row[name] for name in (*labels_of(table), "episode"))
        found.setdefault(row["replica"], {}).setdefault(key, []).append(row[column])
    return {replica: list(episodes.values()) for replica, episodes in found.items()}


def returns(table, **labels):
    return episodes_of(table, "return", **labels)


def told(played, replica=None, **labels):
    """What tells episodes apart, of a list of them, or of a replica in a table."""
    if isinstance(played, list):
        return [(one.steps, one.return_.tolist(), one.shots.tolist(), one.stock_left) for one in played]
    columns = ("steps", "return", "shots", "stock_left")
    of_each = [episodes_of(played, column, replica=replica, **labels)[replica] for column in columns]
    return [
        (steps[0], returns, shots, stock_left[0])
        for steps, returns, shots, stock_left in zip(*of_each, strict=True)
    ]


def command(monkeypatch, capsys, *words):
    monkeypatch.setattr("sys.argv", ["cprl", *map(str, words)])
    monkeypatch.setenv("COLUMNS", "200")  # workers of pytest have 80, which wraps
    cli.main()
    return capsys.readouterr().out
