"""What do trained agents get in fresh worlds when they no longer learn, and explore more or less?

    python recipes/study/governs/frozen.py --study recipes/study/governs/changes.py \
        --runs studies/changes/runs --out docs/results/studies/changes/frozen.parquet

Plays the agents of every finished trial, in the worlds of the study's own evaluation, the same for all
conditions: at the exploration of that evaluation the numbers are those of the study's table, to the last bit,
which is checked. Agents that learn a policy draw from it and have no other exploration: they get the same
numbers under each. Each trial is added to the file as soon as it is played; what the file has is not played
again. A trial that fails stops no other.

Columns: condition, run, replica, exploration, metric, episodes (in which the metric is defined), value (their
mean; null where there are none). Every condition has the income and its equality; without money these are
harvest and equality of the harvest.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import tyro
from finished import finished_trials, name_among

from cprl.commands.recipe_command import exit_with_message
from cprl.measuring.playing import evaluate, turns
from cprl.measuring.registry import COLLECTIVE_RETURN, INCOME, INCOME_EQUALITY
from cprl.measuring.table import all_metrics, by_replica, complete, where
from cprl.policies.actors import LaneActor
from cprl.policies.joint_policy import JointPolicy
from cprl.policies.rng import Purpose
from cprl.population import Scripted
from cprl.runs.episodes import read_rows, table_of, write_table
from cprl.studies.trials import Trial
from cprl.system.output import say
from cprl.training.evaluating import make_worlds
from cprl.training.stored import LoadedRun, StoredAgent, load, stored_policies

SCHEMA: Final = pa.schema(
    {
        "condition": pa.string(),
        "run": pa.string(),
        "replica": pa.int32(),
        "exploration": pa.float64(),
        "metric": pa.string(),
        "episodes": pa.int32(),
        "value": pa.float64(),
    }
)


def play(run: LoadedRun, exploration: float) -> pa.Table:
    """Return the episodes of the evaluation of a run, played once more.

    Args:
        exploration: the probability of a random action of each agent that learned values.
    """
    experiment = run.experiment
    replicas = range(experiment.replicas)
    worlds = experiment.evaluation_episodes

    def agents_at(agent: int) -> list[StoredAgent]:
        return [run.agent(agent, replica=replica) for replica in replicas]

    policy = stored_policies(
        [agents_at(agent) for agent in range(len(run.all_specs))],
        run.playing,
        replicas=replicas,
        worlds=worlds,
        seed=experiment.seed,
    )
    for actor in policy.actors:
        if isinstance(actor, LaneActor):
            actor.epsilon = exploration
    env = make_worlds(experiment, experiment.replicas * worlds, fresh=True)
    if all(ballot.period_episodes == 1 for ballot in run.game.in_force):  # else decisions stay in force
        next(turns(env, _random_policy(run)))
    return complete(table_of(evaluate(env, policy, explore=True), replicas))


def _random_policy(run: LoadedRun) -> JointPolicy:
    """Return what plays the first episode of each world of an evaluation, see `evaluate_population`; of it,
    agents see in their first turn what was voted for."""
    experiment = run.experiment
    agents = [[StoredAgent(spec=Scripted("random"))] * experiment.replicas] * run.game.agents
    return stored_policies(
        agents,
        run.playing,
        replicas=range(experiment.replicas),
        worlds=experiment.evaluation_episodes,
        seed=experiment.seed,
        purpose=Purpose.RANDOM_PLAY,
        decides=Purpose.RANDOM_PLAY,
    )


def rows_of(trial: Trial, table: pa.Table, exploration: float) -> pa.Table:
    """Return the rows of a trial, one for each replica and metric."""
    parts = []
    returns = [f"agent_{agent}/return" for agent in sorted(table["agent"].unique().to_pylist())]
    for metric in dict.fromkeys((*all_metrics(table), INCOME, INCOME_EQUALITY, *returns)):
        values = by_replica(table, name_among(table.column_names, metric))
        labels = {
            "condition": trial.condition.name,
            "run": trial.name,
            "exploration": exploration,
            "metric": metric,
        }
        columns = {name: pa.array([label] * len(values)) for name, label in labels.items()}
        columns["replica"] = pc.add(values["replica"], trial.block.first)
        columns["episodes"] = pc.subtract(values["episodes"], values["undefined"])
        columns["value"] = values["value"]
        parts.append(pa.table({name: columns[name] for name in SCHEMA.names}).cast(SCHEMA))
    return pa.concat_tables(parts)


def is_the_evaluation(trial: Trial, table: pa.Table) -> bool:
    """Return whether episodes have the harvests of the evaluation that the run stores."""
    stored = complete(read_rows(trial.directory / "evaluation" / "trained.parquet"))
    return bool(by_replica(table, COLLECTIVE_RETURN).equals(by_replica(stored, COLLECTIVE_RETURN)))


def explores_as_ever(run: LoadedRun, exploration: float) -> bool:
    """Return whether agents explore so much in the run's own evaluation, or have no exploration."""
    agents = [run.agent(agent, replica=run.replicas[0]) for agent in range(run.game.agents)]
    return all(one.epsilon in (None, exploration) for one in agents)


def played(trial: Trial, explorations: Sequence[float]) -> pa.Table:
    """Return the rows of a trial at some explorations; refuse a run that the library plays in another way now
    than in its evaluation."""
    run = load(trial.directory)
    parts = []
    for exploration in explorations:
        table = play(run, exploration)
        parts.append(rows_of(trial, table, exploration))
        if explores_as_ever(run, exploration) and not is_the_evaluation(trial, table):
            raise ValueError(f"{trial.label}: its evaluation gave other harvests, at {exploration}")
    return pa.concat_tables(parts)


def main(*, study: Path, runs: Path, out: Path, explorations: tuple[float, ...] = (0.05, 0.1)) -> None:
    """Play the agents of all finished trials that the file lacks.

    Args:
        study: the file of the study.
        runs: the directory of its runs.
        out: the file that the rows are added to.
        explorations: the probabilities of a random action.
    """
    rows = pq.read_table(out) if out.exists() else SCHEMA.empty_table()
    failures = []
    for trial in finished_trials(study, runs):
        known = where(rows, run=trial.name)["exploration"].unique().to_pylist()
        missing = [exploration for exploration in explorations if exploration not in known]
        if not missing:
            continue
        try:
            rows = pa.concat_tables([rows, played(trial, missing)])
        except ValueError as error:
            failures.append(str(error))
            continue
        write_table(out, rows, over=True)
        say(f"{trial.label}: played at an exploration of {', '.join(map(str, missing))}")
    if failures:
        raise ValueError("; ".join(failures))


if __name__ == "__main__":
    with exit_with_message("frozen.py"):
        tyro.cli(main)
