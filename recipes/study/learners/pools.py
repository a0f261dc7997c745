"""Is it better to learn against all of one's past selves, or against the newest? Both, cross-played.

    python recipes/study/learners/pools.py studies/pools --out docs/results/learners/pools/pools.csv

On `two_complex` agent 0 learns by DQN. Agent 1 is a pool of its own past: a copy every 20,000 of 200,000
steps, drawn anew for each episode, uniformly from the last eight or always the newest. Then agents 0 play
each other in fresh worlds, each with one of the other training or of its own, always of the next replica,
which it has never met. Nobody learns there.

Expected before it was run: among agents that learned against the newest, those that learned against all get
more, since they have met more kinds of neighbours; among agents that learned against all, no difference can
be told. Contradicted by: a difference below 0, or one that is 0 within 10 apples, in the first; one that
stands by Holm's method for both in the second.

8 replicas of 200,000 steps for each, 3.2 million together.
"""

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Final

import pyarrow as pa
import pyarrow.csv as csv
import tyro

import cprl
from cprl import presets
from cprl.algorithms import DQN
from cprl.commands.recipe_command import exit_with_message
from cprl.evaluation import play_population
from cprl.measuring.table import labelled
from cprl.population import Frozen, Learning, OwnPast, Pool
from cprl.system.output import say

REPLICAS: Final = 8
WORLDS: Final = 16
SETTINGS: Final = replace(
    presets.dqn_settings("two_complex"),
    learning_rate=1e-3,
    gamma=0.97,
    batch_size=64,
    steps_per_update=WORLDS,
    epsilon_decay_steps=100_000,
    target_every_updates=250,
)
OWN_PAST: Final = OwnPast(agent=0, every_steps=20_000, kept=8)
AGAINST: Final = {"all": Pool(own_past=OWN_PAST), "newest": Pool(own_past=OWN_PAST, draw="newest")}
"""The opponents of the two trainings."""
RETURN: Final = "agent_0/return"


def training(against: str, steps: int) -> cprl.Experiment:
    """Return the training of agent 0 against a pool."""
    return cprl.Experiment(
        name=f"against_{against}",
        game=presets.game("two_complex"),
        agents=(Learning(DQN(settings=SETTINGS)), AGAINST[against]),
        steps=steps,
        replicas=REPLICAS,
        worlds=WORLDS,
    )


def main(runs: Path, /, *, out: Path, steps: int = 200_000, episodes: int = 50) -> None:
    """Train against both pools, let the agents play each other, and write what they get.

    Args:
        runs: the directory of the two runs; those that have begun are resumed.
        out: a table of returns and differences, with intervals.
        steps: of each replica.
        episodes: of each replica of each pair.
    """
    trained = {}
    for against in AGAINST:
        directory = runs / against
        trained[against] = cprl.run(
            training(against, steps), directory, resume=directory.exists(), watch="off", figures=False
        )
    next_replica = tuple((replica + 1) % REPLICAS for replica in range(REPLICAS))
    fresh = cprl.Fresh(episodes=episodes, replicas=tuple(range(REPLICAS)))
    tables = []
    for learned, beside in product(AGAINST, repeat=2):
        agents = (
            Frozen(str(trained[learned]), 0, replica=None),
            Frozen(str(trained[beside]), 0, replica=next_replica),
        )
        played = play_population(presets.game("two_complex"), agents, fresh)
        tables.append(labelled(played, learned_against=learned, beside=beside))
    table = pa.concat_tables(tables)
    by = ("learned_against", "beside")
    returns = cprl.estimates(table, RETURN, by)
    gains = cprl.differences(table, RETURN, by, {"learned_against": "newest"})
    say(f"{returns}\n{gains}")
    rows = [labelled(family.table(), what=what) for what, family in (("return", returns), ("gain", gains))]
    out.parent.mkdir(parents=True, exist_ok=True)
    csv.write_csv(pa.concat_tables(rows), out)


if __name__ == "__main__":
    with exit_with_message("pools.py"):
        tyro.cli(main)
