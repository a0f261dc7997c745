"""Plays an episode in which a person decides for one agent, turn by turn."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import pyarrow.compute as pc
import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from cprl import keys
from cprl.commons import maps
from cprl.commons.game import Game
from cprl.commons.published import Variant, check_board
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
    """

    about_others: str = ""
    """Sentences about the other agents."""
    usual: str = ""
    """A sentence about the apples that this agent gets on average in an episode; "" if they are unknown."""

    def __init__(self, env: EnvBase, others: Policy, *, agent: int = 0, decision: int | None = None) -> None:
        commons = commons_of(env)
        assert commons is not None
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
        self._action = 0
        self._turns = turns(env, self._choose)
        self._played: list[TensorDictBase] = []
        self.moments: list[WorldView] = [board_now(self._commons)]
        """The board at the start of the episode and after each turn."""

    @property
    def turn(self) -> int:
        """Return the number of turns that have been played."""
        return len(self.moments) - 1

    @property
    def has_ended(self) -> bool:
        """Return whether the episode has ended: no apple is left and none can grow, or time is over."""
        return bool(self._played) and bool(self._played[-1]["next", keys.DONE].any())

    @property
    def harvested(self) -> list[int]:
        """Return the apples that each agent has harvested so far."""
        return list(map(int, self.moments[-1].harvested))

    @property
    def stock(self) -> int:
        """Return the number of apples on the board."""
        return int(self.moments[-1].stock.sum(dtype=np.int64))

    def act(self, action: str) -> StepOutput:
        """Play a turn in which the person's agent takes this action.

        Returns:
            The output of the turn; the next turn overwrites it.
        """
        if action not in self.game.actions:
            raise refusal("action", action, ", ".join(self.game.actions))
        if self.has_ended:
            raise ValueError("the episode has ended; allowed: turns up to its end")
        self._action = self.game.actions.index(action)
        self._played.append(next(self._turns))
        self.moments.append(board_now(self._commons))
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

    def _choose(self, moment: TensorDictBase) -> TensorDictBase:
        chosen = self._others(moment)
        for key, value in ((keys.ACTION, self._action), (keys.DECISION, self._decision)):
            if value is not None:
                values = chosen[key].clone()
                values[0, self.agent] = value
                chosen[key] = values
        return chosen


def board_named(board: str, variant: Variant) -> tuple[Game, LoadedRun | None]:
    """Return the game that a name stands for, and its run if the name is a run's directory.

    Args:
        board: the name of a published board; the directory of a run; or a file with a drawing of a board, see
            `cprl.maps.parse`, which is played by the published rules.
        variant: the variant of a published board.
    """
    checked("variant", variant, Variant)
    check_board(board)
    if board in presets.names():
        return presets.game(board, variant=variant), None
    if variant != "published":
        raise refusal("variant", variant, f'"published" with {board}, which names no preset')
    path = Path(board)
    if path.is_dir():
        run = load(path)
        return commons_game(run), run
    return Game(map=maps.read_file(path), rules=Rules()), None


@working("preparing an episode")
def open_session(
    board: str,
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
        board: the game, see `board_named`.
        agent: the index of the person's agent.
        others: the other agents: the directory of a run, whose agents play at their indices, or the name of a
            scripted policy. By default the agents of the run that `board` names, or else "greedy".
        replica: the number of the run's replica whose agents play; by default a typical one, see
            `cprl.evaluation.fresh.typical_replica`.
        variant: the variant of a published board.
        steps: the largest number of turns, in place of that of the game.
        seed: the seed of all random choices, with which the others may not have been trained; by default
            40011, or the next seed that differs from theirs. The same seed and the same actions give the same
            episode.
        decision: the person's vote in a game with votes or elections, 0 to `Game.decisions` - 1; None for a
            random vote, as scripted agents have.
    """
    game, run = board_named(board, variant)
    is_game_of_run = steps is None and others in (None, board)
    if steps is not None:
        game = replace(game, rules=replace(game.rules, episode_steps=steps))
    agent = checked("agent", agent, Annotated[int, Range(0, game.agents - 1)])
    if others is None:
        others = "greedy" if run is None else board
    if replica is not None and others in SCRIPTED_POLICIES:
        raise ValueError(f'replica is {replica}, and others is "{others}"; allowed: with the agents of a run')
    others_run = _run_of(others, board, run)
    runs = [] if others_run is None else [others_run]
    if seed is None:
        seed = fresh_seed(runs, PLAY_SEED)
    refuse_trained_in(seed, runs)
    if replica is None and others_run is not None:
        replica = typical_replica(others_run)
    specs = [agent_named(others, index, replica=replica or 0, name="others") for index in range(game.agents)]
    specs[agent] = Scripted("random")
    if run is None:
        env = make_env(game, seed=seed)
    else:
        env = replace(run, experiment=replace(run.experiment, game=game)).env(seed=seed)
    population = Population(env, specs, seed=seed)
    session = Session(env, population.policy(1), agent=agent, decision=decision)
    if others_run is not None:
        averages = averages_in_words(others_run)
        session.about_others = f"The others are of replica {replica}. {averages}".rstrip()
        session.usual = _usual_apples(others_run, agent) if is_game_of_run else ""
    return session


def _run_of(others: str, board: str, run: LoadedRun | None) -> LoadedRun | None:
    """Return the run whose agents are the others; None if they are scripted."""
    if others == board:
        return run
    return load(others) if others not in SCRIPTED_POLICIES and Path(others).is_dir() else None


def _usual_apples(run: LoadedRun, agent: int) -> str:
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
