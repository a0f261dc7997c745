"""open_session: which board is played, and who plays on it."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from cprl import arguments, presets
from cprl.agents import Population
from cprl.commons import maps
from cprl.commons.game import Game
from cprl.commons.rules import Rules
from cprl.envs.make_env import make_env
from cprl.play.session import Session
from cprl.policies.scripted import SCRIPTED_POLICIES
from cprl.population import AgentSpec, Frozen, Scripted
from cprl.presets import Variant
from cprl.stored import LoadedRun, load

SEED: Final = 40_011
"""The default seed; no training of ours uses it."""
DEFAULT_OTHERS: Final = "greedy"
_LONGEST_DRAWING_BYTES: Final = 10_000_000


def open_session(
    board: str,
    *,
    agent: int = 0,
    others: str | None = None,
    replica: int = 0,
    variant: Variant = "published",
    steps: int | None = None,
    seed: int = SEED,
    decision: int | None = None,
    allow: Sequence[str] = (),
) -> Session:
    """An episode for a person and others.

    Args:
        board: the name of a published board, the directory of a run, whose game it is then, or a file with a
            drawing, see `cprl.maps.parse`, played by the published rules.
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
    arguments.choice("variant", variant, presets.VARIANTS)
    game, run = _board(board, variant, allow)
    if steps is not None:
        steps = arguments.integer("steps", steps, 1)
        game = replace(game, rules=replace(game.rules, episode_steps=steps))
    agent = arguments.integer("agent", agent, 0, game.agents - 1)
    others = others if others is not None else DEFAULT_OTHERS if run is None else board
    specs = [_other(others, index, replica) for index in range(game.agents)]
    specs[agent] = Scripted("random")
    if run is None:
        env = make_env(game, seed=seed)
    else:
        env = replace(run, experiment=replace(run.experiment, game=game)).env(seed=seed)
    population = Population(env, specs, seed=seed, allow=allow)
    return Session(env, population.policy(1), agent=agent, decision=decision)


def _board(board: str, variant: Variant, allow: Sequence[str]) -> tuple[Game, LoadedRun | None]:
    """The game, and the run that has it."""
    if board in presets.BOARDS:
        return presets.game(board, variant=variant), None
    path = arguments.path("board", board)
    if not path.is_dir() and not path.is_file():
        names = ", ".join(presets.BOARDS)
        raise ValueError(f"board is {board!r}; allowed: {names}, a run's directory, or a file with a drawing")
    if variant != "published":
        raise ValueError(
            f'variant is "{variant}"; allowed with {board}: "published", since it names no preset'
        )
    if path.is_dir():
        run = load(path, allow=allow)
        if not isinstance(run.game, Game):
            raise ValueError(f"{board} plays a game without a board of cprl; allowed: a run of a cprl.Game")
        return run.game, run
    return Game(map=_drawing(path), rules=Rules()), None


def _drawing(path: Path) -> maps.Map:
    if path.stat().st_size > _LONGEST_DRAWING_BYTES:
        raise ValueError(f"{path} has more than {_LONGEST_DRAWING_BYTES:,} bytes; allowed: a drawing")
    try:
        return maps.parse(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _other(others: str, agent: int, replica: int) -> AgentSpec:
    """How another agent is specified."""
    if others in SCRIPTED_POLICIES:
        return Scripted(others)
    if not arguments.path("others", others).is_dir():
        names = ", ".join(SCRIPTED_POLICIES)
        raise ValueError(f"others is {others!r}; allowed: {names}, or a run's directory")
    return Frozen(others, agent, replica)
