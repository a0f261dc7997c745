"""play_responses: what best responses to stored agents gain, a lower bound of how exploitable these are.

A population is exploitable where somebody who takes one agent's place, while all others stay as they are,
gets more than that agent. How much the best such response gets is unknown; what a trained one gets is a lower
bound. Of several trained ones the best is chosen for each replica, and the maximum of noisy numbers is too
high; so a response is chosen by its returns in some fresh worlds, and what it gains is measured in others.

The gain is that of the game's own rewards, fines and transfers included, whatever the agents of the run want.

Source: of exploitability, M. Lanctot et al., "A Unified Game-Theoretic Approach to Multiagent Reinforcement
Learning" (2017); of lower bounds by trained responses, F. Timbers et al., "Approximate Exploitability:
Learning a Best Response" (2022).
"""

import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from rich.table import Table

from cprl.evaluation.cross_play import Gain
from cprl.evaluation.evaluate import (
    INTERVALS,
    SEED,
    check,
    check_same_game,
    how_they_play,
    opened,
    table_of,
)
from cprl.evaluation.lanes import Fresh, Played
from cprl.evaluation.populations import play_population
from cprl.measuring.statistics import Estimate, difference, estimate
from cprl.population import Frozen
from cprl.runs.episodes import labelled
from cprl.training.agents import LoadedRun, load
from cprl.values import Range, Seed, checked, refusal


def check_population(run: LoadedRun) -> None:
    """Raises a ValueError for a run that no response can be measured against; says why."""
    if run.game.agents < 2:
        raise ValueError(
            f"the game of {run.path} has 1 agent; allowed for best responses: at least 2, since it is the "
            "others that are exploited"
        )
    if run.weights_from.name != "final.pt":
        raise ValueError(
            f"{run.path} was loaded with the weights {run.weights_from.name}; allowed: a run that has ended, "
            "with its final weights, which responses meet"
        )


def consecutive_replicas(run: LoadedRun, replicas: int | None) -> int:
    """How many replicas play: the first ones of a run, by default all."""
    if replicas is None and run.replicas != list(range(len(run.replicas))):
        raise ValueError(f"{run.path} keeps the replicas {run.replicas}; allowed: 0 and those that follow it")
    most = len(run.replicas)
    count = most if replicas is None else checked("replicas", replicas, Annotated[int, Range(1, most)])
    for replica in range(count):
        for agent in range(run.game.agents):
            run.agent(agent, replica=replica)
    return count


def check_seeds(seed: int, episodes: int, runs: Sequence[LoadedRun]) -> int:
    """The seed of fresh worlds; raises a ValueError where it, or the next one, was trained with."""
    seed = checked("seed", seed, Seed)
    for of_worlds in (seed, seed + 1):
        check(episodes=episodes, seed=of_worlds, runs=runs)
    return seed


def check_agents(agents: Sequence[int], run: LoadedRun) -> tuple[int, ...]:
    """Indices of agents of a run's game, at least one and each once."""
    if not agents or len(set(agents)) < len(agents) or not set(agents) <= set(range(run.game.agents)):
        raise refusal("agents", list(agents), f"of 0 to {run.game.agents - 1}, at least one and each once")
    return tuple(agents)


def path_of(run: LoadedRun) -> str:
    """The directory of a run as `Frozen` names it, relative to where we stand."""
    return os.path.relpath(run.path)


Values = NDArray[np.float64]
NOBODY: Final = -1
"""The focal agent in tables where the population itself plays."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Response:
    """A trained response in the place of an agent, in the worlds of the choice and in those reported."""

    agent: int
    """The index of the agent whose place it takes."""
    name: str
    path: Path
    """The run in which it was trained."""
    choosing: Played = field(repr=False)
    reporting: Played = field(repr=False)


@dataclass(frozen=True, kw_only=True, eq=False)
class Exploitability:
    """The episodes of a population and of responses to it; see the docstring of this module."""

    run: LoadedRun
    population: Played = field(repr=False)
    """The episodes of the population itself, in the worlds reported, by replica."""
    responses: Mapping[int, tuple[Response, ...]] = field(repr=False)
    """By the index of the agent whose place they take."""
    fresh: Fresh
    """Episodes in the worlds reported; responses are chosen in as many in worlds of the next seed."""

    @property
    def gain(self) -> Gain:
        """What chosen responses gain over the agents they replace, and what the mean of the others does: the
        mean over these agents, over replicas, with an interval by Student's t."""
        return self._gain({agent: self._best(agent) for agent in self.responses})

    def gain_of(self, agent: int) -> Gain:
        """The same in the place of one agent."""
        agent = self._known(agent)
        return self._gain({agent: self._best(agent)})

    def gain_of_response(self, response: Response) -> Gain:
        """What one response gains in all replicas; nothing is chosen by these numbers."""
        return self._gain({self._known(response.agent): response.reporting})

    def chosen(self, agent: int) -> list[Response]:
        """The response in the place of an agent for each replica: the one with the highest mean return there
        in the worlds where one is chosen, of equal ones the first.
        """
        return self._chosen[self._known(agent)]

    def returns(self, agent: int) -> tuple[Values, Values]:
        """The mean returns, float64 [R] each, of an agent of the population and of what was chosen to take
        its place.
        """
        agent = self._known(agent)
        return _focal(self.population, agent), _focal(self._best(agent), agent)

    def table(self) -> pa.Table:
        """All episodes with the columns of `episodes.parquet`, after "worlds", "choosing" or "reporting";
        "focal_agent", the index of the agent replaced, -1 where none is; "response", its name, "" for none;
        and "chosen", 1 where it is the one chosen for the replica, else 0."""
        parts: list[tuple[dict[str, str | int], int, Any]] = [
            ({"worlds": "reporting", "focal_agent": NOBODY, "response": "", "chosen": 0}, replica, episodes)
            for replica, episodes in self.population.items()
        ]
        for agent, responses in self.responses.items():
            for response in responses:
                for worlds in ("choosing", "reporting"):
                    for replica, episodes in getattr(response, worlds).items():
                        label: dict[str, str | int] = {"worlds": worlds, "focal_agent": agent}
                        label |= {
                            "response": response.name,
                            "chosen": int(self._chosen[agent][replica] is response),
                        }
                        parts.append((label, replica, episodes))
        return labelled(parts)

    @cached_property
    def _chosen(self) -> dict[int, list[Response]]:
        chosen = {}
        for agent, responses in self.responses.items():
            returns = np.stack([_focal(response.choosing, agent) for response in responses])
            chosen[agent] = [responses[place] for place in returns.argmax(0)]
        return chosen

    def _best(self, agent: int) -> Played:
        """The episodes reported, with the response chosen for each replica."""
        return {replica: response.reporting[replica] for replica, response in enumerate(self._chosen[agent])}

    def _gain(self, among: Mapping[int, Played]) -> Gain:
        """Of the episodes with responses by agent; the mean over agents comes first, since places of one
        replica depend on each other."""

        def over(whose: Callable[[Played, int], Values]) -> Estimate:
            reached = np.mean([whose(played, agent) for agent, played in among.items()], 0)
            usual = np.mean([whose(self.population, agent) for agent in among], 0)
            return difference(reached, usual, paired=True)

        return Gain(focal=over(_focal), background=over(_others))

    def _known(self, agent: int) -> int:
        if agent not in self.responses:
            raise refusal("agent", agent, f"one of {sorted(self.responses)}, which have responses")
        return agent


def play_responses(
    run: str | Path | LoadedRun,
    responses: Mapping[int, Mapping[str, str | Path | Frozen]],
    *,
    episodes: int = 20,
    replicas: int | None = None,
    seed: int = SEED,
    allow: Sequence[str] = (),
) -> Exploitability:
    """Plays a stored population, and trained responses in the places of its agents, in the same fresh worlds.

    In replica r the agents of the population are those of the run's replica r, and the response is what
    replica r of its run learned in that place, or another replica that a `Frozen` names. All explore as in
    evaluation.

    Args:
        run: the population: its directory, or a value of `cprl.load`; its replicas are 0, 1 and so on.
        responses: by the index of the agent whose place is taken, directories of runs by the names of
            responses, e.g. {0: {"PPO": "runs/against"}}, or what they learned in that place, e.g.
            {0: {"PPO": Frozen("runs/against", 0, replica=(2, 3))}}; they have the same game.
        episodes: episodes of each replica with each response where one is chosen, and as many where the gain
            is measured.
        replicas: how many of the run's replicas play, the first ones; by default all.
        seed: of the worlds reported; the next seed is that of the worlds where responses are chosen. Neither
            is the seed of a training.
    """
    population = opened(run, allow)
    check_population(population)
    trained = _opened(responses, population)
    count = consecutive_replicas(population, replicas)
    stored = [run for table in trained.values() for run, _ in table.values()]
    seed = check_seeds(seed, episodes, [population, *stored])
    itself = [Frozen(path_of(population), other, replica=None) for other in range(population.game.agents)]
    fresh: dict[str, Any] = {"episodes": episodes, "replicas": count}

    def played(agent: int, name: str, trained_in: LoadedRun, response: Frozen) -> Response:
        among = list(itself)
        among[agent] = response
        choosing, reporting = (
            play_population(population, among, seed=chance, **fresh) for chance in (seed + 1, seed)
        )
        return Response(agent=agent, name=name, path=trained_in.path, choosing=choosing, reporting=reporting)

    return Exploitability(
        run=population,
        population=play_population(population, itself, seed=seed, **fresh),
        responses={
            agent: tuple(played(agent, name, *response) for name, response in table.items())
            for agent, table in trained.items()
        },
        fresh=Fresh(replicas=tuple(range(count)), episodes=episodes, seed=seed),
    )


def _opened(
    responses: Mapping[int, Mapping[str, str | Path | Frozen]], population: LoadedRun
) -> dict[int, dict[str, tuple[LoadedRun, Frozen]]]:
    """Responses by agent and name, of the same game as the population: their runs, and what plays of them."""
    opened_responses: dict[int, dict[str, tuple[LoadedRun, Frozen]]] = {}
    for agent in check_agents(list(responses), population):
        table = responses[agent]
        if not table:
            raise refusal(f"responses[{agent}]", table, "at least one directory or Frozen by name")
        opened_responses[agent] = {}
        for name, given in table.items():
            where = f"responses[{agent}][{name!r}]"
            if not isinstance(given, Frozen):
                given = Frozen(str(given), agent, replica=None)
            if given.agent != agent:
                raise refusal(where, given, f"agent {agent} of a run, whose place it takes")
            trained_in = load(given.run)
            check_same_game({str(population.path): population, str(trained_in.path): trained_in})
            opened_responses[agent][name] = trained_in, given
    return opened_responses


def _focal(played: Played, agent: int) -> Values:
    """The mean return of an agent in each replica, [R]."""
    return np.array(
        [np.mean([episode.return_[agent] for episode in episodes]) for episodes in played.values()]
    )


def _others(played: Played, agent: int) -> Values:
    """The mean return of the other agents in each replica, [R]."""
    return np.array(
        [np.mean([np.delete(episode.return_, agent) for episode in episodes]) for episodes in played.values()]
    )


def exploitability_tables(measured: Exploitability) -> Iterator[Table]:
    """A row for each agent that was replaced and one for their mean, then one for each trained response."""
    yield _gains(measured)
    rows = [
        (str(agent), response.name, str(measured.gain_of_response(response).focal))
        for agent, responses in measured.responses.items()
        for response in responses
    ]
    yield table_of("each training, chosen or not", ["agent", "response", "gain"], rows, texts=2)


def _gains(measured: Exploitability) -> Table:
    run, fresh = measured.run, measured.fresh
    headings = ("return of the agent", "of the best response", "gain", "change of the others, mean")
    rows = []
    for agent in measured.responses:
        gain, returns = measured.gain_of(agent), measured.returns(agent)
        chosen = Counter(response.name for response in measured.chosen(agent))
        names = "\n".join(f"{name}: {times}" for name, times in chosen.most_common())
        means = (str(estimate(values)) for values in returns)
        rows.append((str(agent), *means, str(gain.focal), str(gain.background), names))
    if len(measured.responses) > 1:
        rows.append(("mean", "", "", str(measured.gain.focal), str(measured.gain.background), ""))
    table = table_of(
        f"{run.path.name}: {fresh}, seed {fresh.seed}{how_they_play([run], fresh)}\n"
        "What trained responses gain is a lower bound of what can be gained.\n"
        f"{INTERVALS}; gain and change paired by replica",
        ["agent", *headings, "chosen in replicas"],
        rows,
    )
    table.columns[-1].justify = "left"
    return table
