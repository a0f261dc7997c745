"""HostedSession: everything that is decided about a hosted game before the first person joins, as a value."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, TypeAlias

from cprl.commons import maps
from cprl.commons.game import Game
from cprl.evaluation.fresh import typical_replica
from cprl.evaluation.play import game_and_run
from cprl.institutions import Institution
from cprl.policies.governors import ScriptedGovernor
from cprl.policies.scripted import ScriptedPolicy
from cprl.population import AgentSpec, Frozen, GovernorSpec, Scripted
from cprl.training.stored import LoadedRun, load
from cprl.values import checked, refusal
from cprl.web.hosting import STAY, TRAINED, Hosting, ShortText

Treatment: TypeAlias = Game | tuple[Institution, ...]
"""What a round is played by: institutions in place of those of the session's game, or a whole game."""


@dataclass(frozen=True, kw_only=True)
class HostedSession(Hosting, stored=False, called="session"):
    """A game that people play in groups, in one round or several, under treatments in an order."""

    game: Game | str
    """The game; or the name of a published board, the directory of a run, or a file with a drawing."""
    rounds: tuple[tuple[ShortText, Treatment], ...] = ()
    """The treatment of each round with its name; () for one round of the game as it is."""
    governor: Frozen | ScriptedGovernor | None = None
    """By what the governor of a game decides, see `cprl.Experiment.governor`; None for that of the run whose
    agents may play, if it fits, or else the first option."""
    consent: str | None = field(default=None, repr=False)
    """The text that people consent to before they play; None for none."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for word in self.agents:
            checked("session.agents", word, Literal["trained"] | ScriptedPolicy)
        checked("session.absent", self.absent, Literal["stay"] | ScriptedPolicy)

    @cached_property
    def _base(self) -> tuple[Game, LoadedRun | None]:
        """Return the game before any treatment, and the run whose game it is."""
        return game_and_run(self.game, "published") if isinstance(self.game, str) else (self.game, None)

    def games(self) -> list[tuple[str, Game]]:
        """Return the name and the game of each round, with a start for each agent.

        Raises:
            ValueError: for a round that people cannot play; names the round.
        """
        game, _ = self._base
        rounds = self.rounds or (("the game", game),)
        games = [(name, self._game_of(name, game, rules)) for name, rules in rounds]
        if self.governor is not None and all(game.governor is None for _, game in games):
            raise refusal("session.governor", self.governor, "None where no round has a Governor")
        return games

    def _game_of(self, name: str, base: Game, rules: Treatment) -> Game:
        """Return the game of a round."""
        try:
            game = rules if isinstance(rules, Game) else replace(base, institutions=rules)
            game = replace(game, map=maps.with_agents(game.map, self.people + len(self.agents)))
            if game.governor is not None and isinstance(self.governor, ScriptedGovernor):
                self.governor.check(game.governor)
            return with_turns(game, self.turns or game.rules.episode_steps)
        except ValueError as error:
            raise ValueError(f"round {name!r}: {error}") from error

    def trained_runs(self) -> list[LoadedRun]:
        """Return the runs whose agents may play, that of `game` first.

        Raises:
            ValueError: if agents are to be "trained" and there is no run; for a run with transforms.
        """
        runs = [load(path) for path in self.runs]
        _, base_run = self._base
        if base_run is not None:
            runs.insert(0, base_run)
        for run in runs:
            if run.experiment.transforms:
                raise ValueError(f"{run.path} has transforms of its game, in which people cannot play")
        if TRAINED in self.agents and not runs:
            raise refusal("session.agents", TRAINED, "with a run, as the game or among the runs")
        return runs

    def specs(self, run: LoadedRun | None) -> list[AgentSpec]:
        """Return the specification of each agent as it plays; people stand as what they are when absent.

        Args:
            run: the run of the agents that are trained; each is the agent of its own index there, or of the
                index modulo the number of agents.
        """
        policies = [self.absent if self.absent != STAY else "random"] * self.people
        specs: list[AgentSpec] = []
        for agent, word in enumerate([*policies, *self.agents]):
            if word == TRAINED and run is not None:
                path = os.path.relpath(run.path)
                specs.append(Frozen(path, agent % run.game.agents, replica=typical_replica(run)))
            else:
                specs.append(Scripted(word))  # type: ignore[arg-type]
        return specs

    def governor_of(self, game: Game, runs: Sequence[LoadedRun]) -> GovernorSpec | None:
        """Return by what the governor of a round's game decides; None without one, and where its first option
        stays in force.

        Args:
            runs: the runs whose governors may decide.
        """
        if game.governor is None:
            return None
        if self.governor is not None:
            return self.governor
        for run in runs:
            if run.experiment.governor is not None and run.game.governor == game.governor:
                return Frozen(os.path.relpath(run.path), run.game.agents, replica=typical_replica(run))
        return None

    def names(self) -> list[str]:
        """Return what the agents of a group are called, e.g. "person 2" and "agent 5 (trained)"."""
        people = [f"person {agent}" for agent in range(self.people)]
        others = [f"agent {agent} ({word})" for agent, word in enumerate(self.agents, start=self.people)]
        return [*people, *others]


def with_turns(game: Game, turns: int) -> Game:
    """Return a game whose episodes have so many turns at most."""
    return replace(game, rules=replace(game.rules, episode_steps=turns))
