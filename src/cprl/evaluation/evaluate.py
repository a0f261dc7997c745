"""evaluate_run: compares the agents of a stored run with the random policy in fresh worlds; and what all
evaluations share: whether runs have the same game, and tables for the terminal."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import torch

from cprl.envs.make_env import stored_game
from cprl.envs.unwrap import agent_names
from cprl.evaluation.lanes import Fresh, Part, Played, Results, agents_of, fresh_of, scripted
from cprl.measuring.played import (
    Measured,
    agents_without_harvest,
    by_metric,
    clock_of,
    difference_paired,
    notes_on,
    over_replicas,
)
from cprl.measuring.registry import left_out, with_unit
from cprl.measuring.series import OF_AGENTS, Values
from cprl.measuring.statistics import Estimate, signed
from cprl.system.defaults import SEED as SEED
from cprl.system.working import working
from cprl.terminal.tables import Cells
from cprl.training.agents import LoadedRun, load
from cprl.values import checked, differences, to_config

MOST_DIFFERENCES: Final = 3
"""Of those in which games differ, in a message."""
BESIDE_RANDOM: Final = ("", "run's agents", "random")
"""The columns of a table of a run's agents and of random ones."""


def refuse_other_games(runs: Mapping[str, LoadedRun]) -> None:
    """Raises a ValueError where a run, by its name, has another game than the first, or other transforms."""
    first, *others = runs
    for name in others:
        run, other = runs[first].experiment, runs[name].experiment
        refuse_unlike(f"{first} and {name}", run.game, other.game)
        refuse_unlike(f"{first} and {name}", run.transforms, other.transforms, "transforms")
        learned = differing(runs[first].transforms_state, runs[name].transforms_state)
        if learned:
            raise ValueError(f"{first} and {name}: the learned state of transforms differs: {learned}")


def differing(state: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    """The entries of what transforms have learned that another has not, or otherwise."""
    return [
        name
        for name, value in state.items()
        if name not in other or not torch.equal(torch.as_tensor(value), torch.as_tensor(other[name]))
    ]


def refuse_unlike(names: str, game: Any, other: Any, what: str = "") -> None:
    """Raises a ValueError that says where two games differ."""
    before, now = (to_config(stored_game(value)) for value in (game, other))
    lines = differences(before, now, what or type(game).__name__)
    if lines:
        raise ValueError(
            f"{names} have different games: {'; '.join(lines[:MOST_DIFFERENCES])}; allowed: the same game"
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Evaluation(Results):
    """Fresh episodes of a run's agents and, in the same worlds, of uniformly random ones, by "policy":
    "trained" or "random"."""

    run: LoadedRun

    @property
    def trained(self) -> Played:
        """The episodes of the run's agents by replica."""
        return self.where(policy="trained").played

    @property
    def random(self) -> Played:
        return self.where(policy="random").played

    def measures(self, policy: str = "trained") -> dict[str, Measured]:
        """The social metrics over replicas by name, those of institutions as `institutions/fines` and so on,
        then the agents' returns, and what they paid, got and broke, as `agent_0/return` and so on."""
        clock = clock_of(self.played)
        return {name: over_replicas(values, name, clock) for name, values in self._values(policy).items()}

    def differences(self) -> dict[str, Estimate | None]:
        """Return how much more the run's agents have of each of `measures` than random ones, paired by
        replica, which play the same worlds; None where a metric is undefined."""
        trained = self._values("trained")
        random = self._values("random")
        clock = clock_of(self.played)
        return {
            name: difference_paired(values, random[name], name, clock) for name, values in trained.items()
        }

    def _values(self, policy: str) -> dict[str, dict[int, list[float]]]:
        """Return the values of all measures by replica."""
        played = self.where(policy=checked("policy", policy, Literal["trained", "random"])).played
        first = next(iter(played.values()))[0]
        names = {"return_": "return"}
        names |= {name: name for name in OF_AGENTS if getattr(first, name) is not None}
        of_agents = {
            f"{agent_name}/{name}": {
                replica: [float(getattr(episode, entry)[agent]) for episode in episodes]
                for replica, episodes in played.items()
            }
            for entry, name in names.items()
            for agent, agent_name in enumerate(agent_names(self.run.env()))
        }
        of_all = by_metric(played, attrgetter("social")) | by_metric(played, attrgetter("of_institutions"))
        return of_all | of_agents


@working("evaluating")
def evaluate_run(
    run: str | Path | LoadedRun,
    *,
    episodes: int = 20,
    greedy: bool = False,
    seed: int = SEED,
    replicas: Sequence[int] = (),
) -> Evaluation:
    """Plays fresh episodes with every replica of a stored run, and with the random policy in the same worlds.

    Args:
        run: its directory, its exported results, or a value of `cprl.load`. For a run that has not ended, the
            newest checkpoint is used.
        episodes: episodes of each replica, each in its own world.
        greedy: whether agents take the action with the highest value or probability; else agents with values
            explore with the run's `epsilon_evaluation`, and agents with a policy sample from it. Scripted
            agents are not affected.
        seed: the seed of the worlds and of all random numbers; equal seeds give equal episodes.
        replicas: the indices of the replicas that play; by default all. A replica's episodes do not depend on
            the others.
    """
    loaded = opened(run)
    fresh = fresh_of([loaded], episodes=episodes, greedy=greedy, seed=seed, replicas=replicas)
    policies = {"trained": agents_of(loaded), "random": [scripted("random")] * loaded.game.agents}
    parts = [Part({"policy": policy}, fresh.play(loaded, agents)) for policy, agents in policies.items()]
    return Evaluation(run=loaded, fresh=fresh, parts=parts)


def opened(run: str | Path | LoadedRun) -> LoadedRun:
    return run if isinstance(run, LoadedRun) else load(run)


def bars_of(estimates: Iterable[Estimate]) -> tuple[Values, Values]:
    """Values, float64 [K], and how far their intervals reach below and above, [2, K], as `errorbar` takes
    them; 0 where there is none."""
    means, low, high = np.array([(mean.value, *mean.interval) for mean in estimates]).T
    return means, np.nan_to_num([means - low, high - means])


def run_table(evaluation: Evaluation) -> Cells:
    """A row for each metric: mean over replicas and 95 % interval, of the run's agents and random agents, and
    their difference, paired by replica.

    Metrics of institutions that are undefined everywhere, since the game has other institutions, have none.
    """
    trained, random = evaluation.measures("trained"), evaluation.measures("random")
    differences = evaluation.differences()
    rewards = unit_of_rewards(evaluation)
    rows: list[tuple[str, ...]] = [
        (with_unit(name, rewards=rewards), str(measured), str(random[name]), signed(differences[name]))
        for name, measured in trained.items()
        if not says_nothing(name, [measured, random[name]])
    ]
    zeros = "Numbers of institutions that are 0 or undefined everywhere are left out."
    zeros *= len(rows) < len(trained)
    without = [agents_without_harvest(played) for played in (evaluation.trained, evaluation.random)]
    if None not in without:
        counts = (f"{count[0]} of {count[1]}" for count in without if count)
        rows.append(("agents without a harvest, not in sustainability", *counts, ""))
    lacking = left_out(next(iter(evaluation.trained.values()))[0].reported)
    notes = lacking, zeros, *notes_on([*trained.values(), *random.values()])
    title = heading(evaluation.run.path.name, evaluation.fresh, [evaluation.run])
    head = [*BESIDE_RANDOM, "run's agents - random, paired"]
    return Cells(title, head, rows, "\n".join(filter(None, notes)))


def says_nothing(name: str, measured: Iterable[Measured]) -> bool:
    """Whether it is of institutions, and undefined or 0 everywhere: what no institution of the game does."""
    kinds = name.startswith("institutions/"), name.endswith(("/fines", "/transfers", "/violations"))
    values = [of_run.estimate.value for of_run in measured if of_run.estimate is not None]
    return any(kinds) and not any(values) and "in_force" not in name


def unit_of_rewards(results: Results) -> str:
    """Rewards are apples in a game that reports harvests; in another they have no unit."""
    return "apples" if next(iter(results.played.values()))[0].harvest is not None else ""


def heading(what: str, fresh: Fresh, runs: Iterable[LoadedRun], each: str = "", end: str = "") -> str:
    """What was played, with the epsilon of the agents that learned values, and what numbers are."""
    agents = [run.agent(agent, replica=run.replicas[0]) for run in runs for agent in range(run.game.agents)]
    chances = {agent.epsilon for agent in agents if agent.scripted is None and not agent.stochastic}
    exploring = ", greedy" if fresh.greedy else "".join(f", epsilon {chance:g}" for chance in sorted(chances))
    return (
        f"{what}: {fresh}{each}, seed {fresh.seed}{exploring}{end}\n"
        "mean over replicas [95 % interval by Student's t]"
    )
