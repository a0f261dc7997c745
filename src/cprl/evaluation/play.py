"""Plays an episode in which a person decides for one agent, turn by turn."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import pyarrow.compute as pc
import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from cprl import keys
from cprl.commons import maps
from cprl.commons.game import Game
from cprl.commons.named_games import Variant, check_game_source
from cprl.commons.rules import Rules
from cprl.commons.world import StepOutput, WorldView
from cprl.envs.make_env import make_env
from cprl.envs.unwrap import commons_of
from cprl.evaluation.fresh import averages_in_words, board_now, fresh_seed, typical_replica
from cprl.evaluation.populations import agent_named, commons_game, refuse_trained_in
from cprl.experiment import presets
from cprl.measuring import social
from cprl.measuring.playing import Policy, turns
from cprl.measuring.table import where
from cprl.policies.scripted import SCRIPTED_POLICIES
from cprl.population import Scripted
from cprl.runs.episodes import read_rows
from cprl.system.defaults import PLAY_SEED
from cprl.system.working import working
from cprl.training.agents import Population
from cprl.training.stored import LoadedRun, load
from cprl.values import Range, checked, refusal


class Session:
    """An episode that a person plays turn by turn.

    Args:
        env: one world of a `CommonsEnv`, with or without transforms; it is reset.
        others: the policy of all agents; the action of the person's agent is replaced.
        agent: the index of the person's agent.
        decision: the person's vote, see `Game.decisions`; None for the vote that `others` choose.
        about_others: sentences about the other agents.
        average_harvest_text: a sentence about the apples that this agent gets on average in an episode; "" if
            they are unknown.

    Raises:
        ValueError: for an environment that is not of the commons, or a decision that agents cannot make.
    """

    def __init__(
        self,
        env: EnvBase,
        others: Policy,
        *,
        agent: int = 0,
        decision: int | None = None,
        about_others: str = "",
        average_harvest_text: str = "",
    ) -> None:
        commons = commons_of(env)
        if commons is None:
            raise refusal("env", type(env).__name__, "a CommonsEnv, with or without transforms")
        self._commons = commons
        self._others = others
        self.game = commons.game
        self.agent = agent
        """The index of the person's agent."""
        if decision is not None:
            if not self.game.decisions:
                raise refusal("decision", decision, "None: agents decide nothing in this game")
            checked("decision", decision, Annotated[int, Range(0, self.game.decisions - 1)])
        self._decision = decision
        self.about_others = about_others
        self.average_harvest_text = average_harvest_text
        self._action = 0
        self._turns = turns(env, self._choose)
        self._played: list[TensorDictBase] = []
        self.boards: list[WorldView] = [board_now(self._commons)]
        """The board at the start of the episode and after each turn."""

    @property
    def turn(self) -> int:
        """Return the number of turns that have been played."""
        return len(self.boards) - 1

    @property
    def has_ended(self) -> bool:
        """Return whether the episode has ended: no apple is left and none can grow, or time is over."""
        return bool(self._played) and bool(self._played[-1]["next", keys.DONE].any())

    @property
    def harvested(self) -> list[int]:
        """Return the apples that each agent has harvested so far."""
        return list(map(int, self.boards[-1].harvested))

    @property
    def stock(self) -> int:
        """Return the number of apples on the board."""
        return int(self.boards[-1].stock.sum(dtype=np.int64))

    def act(self, action: str) -> StepOutput:
        """Play a turn in which the person's agent takes this action, one of `Game.actions`.

        Returns:
            The output of the turn; the next turn overwrites it.

        Raises:
            ValueError: for an unknown action, or after the end of the episode.
        """
        if action not in self.game.actions:
            raise refusal("action", action, ", ".join(self.game.actions))
        if self.has_ended:
            raise ValueError("the episode has ended; allowed: turns up to its end")
        self._action = self.game.actions.index(action)
        self._played.append(next(self._turns))
        self.boards.append(board_now(self._commons))
        return self._commons.output

    def metrics(self) -> dict[str, float]:
        """Return the metrics of the turns so far: those of `cprl.measuring.social.summary`, and stock_left.

        An undefined metric is NaN. Before the first turn there are none.
        """
        if not self._played:
            return {}
        harvest = torch.cat([batch["next"][keys.HARVEST] for batch in self._played])
        measured = social.summary(harvest, torch.cat([batch[keys.IN_PLAY] for batch in self._played]))
        return {**{name: float(value) for name, value in measured.items()}, "stock_left": float(self.stock)}

    def _choose(self, observed: TensorDictBase) -> TensorDictBase:
        """Replace the person's action, and vote if given, in what the others' policy chooses."""
        chosen = self._others(observed)
        for key, value in ((keys.ACTION, self._action), (keys.DECISION, self._decision)):
            if value is not None:
                values = chosen[key].clone()
                values[0, self.agent] = value
                chosen[key] = values
        return chosen


def game_and_run(source: str, variant: Variant) -> tuple[Game, LoadedRun | None]:
    """Return the game that a word stands for, and its run if the word is a run's directory.

    Args:
        source: the name of a game, see `cprl.presets.game`; the directory of a run; or a file with a drawing
            of a board, see `cprl.maps.parse`, which is played by the published rules.
        variant: the variant of a published game.

    Raises:
        ValueError: for a word that stands for no game, or a variant that the game lacks.
    """
    check_game_source(source)
    if source in presets.names():
        return presets.game(source, variant=variant), None
    if variant != "published":
        raise refusal("variant", variant, f'"published" with {source}, which names no preset')
    path = Path(source)
    if path.is_dir():
        run = load(path)
        return commons_game(run), run
    return Game(map=maps.read_file(path), rules=Rules()), None


class _Others(NamedTuple):
    """The agents among which a person plays."""

    name: str
    """The name of a scripted policy, or the directory of a run."""
    run: LoadedRun | None
    """The run whose agents they are; None for scripted agents."""
    replica: int
    """The replica of the run; 0 for scripted agents."""


def _others_from(others: str | None, game_source: str, run: LoadedRun | None, replica: int | None) -> _Others:
    """Return the other agents; `run` is that of `game_source`, if this is the directory of a run."""
    name = others or ("greedy" if run is None else game_source)
    if name in SCRIPTED_POLICIES:
        if replica is not None:
            raise ValueError(
                f'replica is {replica}, and others is "{name}"; allowed: with the agents of a run'
            )
        return _Others(name, None, 0)
    if name != game_source:
        run = load(name) if Path(name).is_dir() else None
    if replica is None:
        replica = 0 if run is None else typical_replica(run)
    return _Others(name, run, replica)


@working("preparing an episode")
def open_session(
    game_source: str,
    *,
    agent: int = 0,
    others: str | None = None,
    replica: int | None = None,
    variant: Variant = "published",
    steps: int | None = None,
    seed: int | None = None,
    decision: int | None = None,
) -> Session:
    """Begin an episode for a person and other agents.

    Args:
        game_source: the game, see `game_and_run`.
        agent: the index of the person's agent.
        others: the other agents: the directory of a run, whose agents play at their indices, or the name of a
            scripted policy. By default the agents of the run that `game_source` names, or else "greedy".
        replica: the number of the run's replica whose agents play; by default a typical one, see
            `cprl.evaluation.fresh.typical_replica`.
        variant: the variant of a published game.
        steps: the largest number of turns, in place of that of the game.
        seed: the seed of all random choices, with which the others may not have been trained; by default
            40011, or the next seed that differs from theirs. The same seed and the same actions give the same
            episode.
        decision: the person's vote in a game with votes or elections, 0 to `Game.decisions` - 1; None for a
            random vote, as scripted agents have.

    Raises:
        ValueError: for a value that the game or the run of the other agents does not have, or a seed with
            which they were trained.
    """
    game, run = game_and_run(game_source, variant)
    if steps is not None:
        game = replace(game, rules=replace(game.rules, episode_steps=steps))
    agent = checked("agent", agent, Annotated[int, Range(0, game.agents - 1)])
    other_agents = _others_from(others, game_source, run, replica)
    runs_of_others = [] if other_agents.run is None else [other_agents.run]
    if seed is None:
        seed = fresh_seed(runs_of_others, PLAY_SEED)
    refuse_trained_in(seed, runs_of_others)
    specs = [
        agent_named(other_agents.name, index, replica=other_agents.replica, name="others")
        for index in range(game.agents)
    ]
    specs[agent] = Scripted("random")
    if run is None:
        env = make_env(game, seed=seed)
    else:
        env = replace(run, experiment=replace(run.experiment, game=game)).env(seed=seed)
    about_others = ""
    if other_agents.run is not None:
        averages = averages_in_words(other_agents.run)
        about_others = f"The others are of replica {other_agents.replica}. {averages}".rstrip()
    average_harvest_text = ""
    if run is not None and run is other_agents.run and steps is None:
        average_harvest_text = _average_harvest_text(run, agent)
    return Session(
        env,
        Population(env, specs, seed=seed).policy(1),
        agent=agent,
        decision=decision,
        about_others=about_others,
        average_harvest_text=average_harvest_text,
    )


def _average_harvest_text(run: LoadedRun, agent: int) -> str:
    """Return a sentence about an agent's average harvest in the run's evaluation, trained and at random.

    Return "" if the run has no such evaluation.
    """
    apples = []
    for policy in ("trained", "random"):
        path = run.path / "evaluation" / f"{policy}.parquet"
        table = read_rows(path) if run.networks and path.is_file() else None
        if table is None or "harvest" not in table.column_names:
            return ""
        harvest = where(table, agent=agent)["harvest"]
        apples.append(f"{pc.mean(harvest).as_py():,.0f}")
    trained, random = apples
    return f"On average trained agent {agent} gets {trained}, and {random} where all act at random."
