"""open_session: which board is played, and who plays on it."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from cprl import arguments
from cprl.agents import Population
from cprl.envs.make_env import make_env
from cprl.evaluation.words import agent_named, board_named
from cprl.play.session import Session
from cprl.policies.scripted import SCRIPTED_POLICIES
from cprl.population import Scripted
from cprl.presets import Variant

DEFAULT_OTHERS: Final = "greedy"


def open_session(
    board: str,
    *,
    agent: int = 0,
    others: str | None = None,
    replica: int = 0,
    variant: Variant = "published",
    steps: int | None = None,
    seed: int = arguments.PLAY_SEED,
    decision: int | None = None,
    allow: Sequence[str] = (),
) -> Session:
    """An episode for a person and others.

    Args:
        board: see `cprl.evaluation.words.board_named`.
        agent: the index of the person's agent.
        others: the directory of a run, whose agents with the same indices play, or a scripted policy; by
            default the agents of the run that `board` names, else "greedy".
        replica: the index of the run's replica whose agents play.
        variant: of a published board, see `presets.game`.
        steps: turns of the episode at most, in place of those of the game.
        seed: of all random numbers; equal seeds and equal actions give equal episodes.
        decision: what the person decides in a game with votes or elections, 0 to `Game.decisions` - 1; None
            for a choice by chance, as of a scripted agent.
        allow: see `cprl.load`.

    Raises:
        ValueError: for a board or others that are unknown, or do not fit each other; says what does.
    """
    seed = arguments.seed(seed)
    replica = arguments.integer("replica", replica, 0)
    game, run = board_named(board, variant, allow=allow)
    if steps is not None:
        steps = arguments.integer("steps", steps, 1)
        game = replace(game, rules=replace(game.rules, episode_steps=steps))
    agent = arguments.integer("agent", agent, 0, game.agents - 1)
    others = others if others is not None else DEFAULT_OTHERS if run is None else board
    if replica and others in SCRIPTED_POLICIES:
        raise ValueError(f'replica is {replica}, and others is "{others}"; allowed: with the agents of a run')
    specs = [agent_named(others, index, replica=replica) for index in range(game.agents)]
    specs[agent] = Scripted("random")
    if run is None:
        env = make_env(game, seed=seed)
    else:
        env = replace(run, experiment=replace(run.experiment, game=game)).env(seed=seed)
    population = Population(env, specs, seed=seed, allow=allow)
    return Session(env, population.policy(1), agent=agent, decision=decision)
