"""Play: an episode in which a person decides for one agent, in the terminal, also through a pipe."""

import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from math import isnan
from pathlib import Path
from typing import Annotated, Final

import numpy as np
import torch
from rich.text import Text
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from cprl import keys
from cprl.commons import maps
from cprl.commons.colours import APPLE, BEAM, CLEANING, PALETTE, WALL, WASTE, WATER, Colour, agent_colour
from cprl.commons.game import Game
from cprl.commons.maps import SIGN_OF_HEADING
from cprl.commons.published import Variant, check_board
from cprl.commons.rules import Rules
from cprl.commons.world import Shown, StepOutput
from cprl.envs.make_env import make_env
from cprl.envs.unwrap import commons_of
from cprl.evaluation.lanes import Turns, agent_named, board_now, commons_game
from cprl.experiment import presets
from cprl.measuring import social
from cprl.measuring.evaluate import Policy
from cprl.measuring.metrics import title
from cprl.policies.scripted import SCRIPTED_POLICIES
from cprl.population import Scripted
from cprl.system.defaults import PLAY_SEED
from cprl.system.output import OUT, console, say
from cprl.system.working import working
from cprl.training.agents import LoadedRun, Population, load
from cprl.values import Range, checked, refusal, trust

KEYS: Final = {
    "w": ("forward", "step forward"),
    "s": ("backward", "step back"),
    "a": ("left", "step left"),
    "d": ("right", "step right"),
    "q": ("turn_left", "turn left"),
    "e": ("turn_right", "turn right"),
    "f": ("beam", "fire the beam"),
    "h": ("harvest", "harvest"),
    "c": ("clean", "clean the river"),
    ".": ("stay", "stay"),
}
"""The action of each key, and what it is called."""
QUIT: Final = "quit"
_PROMPT: Final = "keys> "


def help_of(game: Game) -> str:
    """Return all keys of a game in a line: "w step forward, s step back, ..."."""
    return ", ".join(f"{key} {words}" for key, (action, words) in KEYS.items() if action in game.actions)


class Session:
    """The episode, turn by turn.

    Args:
        env: one world of a `CommonsEnv`, with or without transforms; it is reset.
        others: writes the actions of all agents; that of the person's agent is replaced.
        decision: what the person decides, see `Game.decisions`; None for what `others` write.
    """

    def __init__(self, env: EnvBase, others: Policy, *, agent: int = 0, decision: int | None = None) -> None:
        commons = commons_of(env)
        assert commons is not None
        self._commons, self._others, self.game = commons, others, commons.game
        self.agent = agent
        """The index of the person's agent."""
        if decision is not None:
            if not self.game.decisions:
                raise refusal("decision", decision, "None: agents decide nothing in this game")
            checked("decision", decision, Annotated[int, Range(0, self.game.decisions - 1)])
        self._decision, self._action = decision, 0
        self._turns = Turns(env, self._choose)
        self._played: list[TensorDictBase] = []
        self.moments: list[Shown] = [board_now(self._commons)]
        """The board as the episode began, then after each turn."""

    @property
    def turn(self) -> int:
        return len(self.moments) - 1

    @property
    def has_ended(self) -> bool:
        """Whether the episode has ended: no apple is left and none can grow, or time is over."""
        return self._turns.has_ended

    @property
    def harvested(self) -> list[int]:
        return [int(apples) for apples in self.moments[-1].harvested]

    @property
    def stock(self) -> int:
        return int(self.moments[-1].stock.sum(dtype=np.int64))

    def act(self, action: str) -> StepOutput:
        """Play a turn: the person's agent takes this action, the others choose theirs.

        Returns:
            What the turn brought, overwritten by the next one.
        """
        if action not in self.game.actions:
            raise refusal("action", action, ", ".join(self.game.actions))
        self._action = self.game.actions.index(action)
        self._played.append(self._turns.play())
        self.moments.append(board_now(self._commons))
        return self._commons.output

    def metrics(self) -> dict[str, float]:
        """Return the metrics of `cprl.measuring.social.summary` of the turns played so far, and stock_left;
        NaN where undefined, empty before the first turn."""
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


def state(session: Session) -> str:
    """Return the turn, the apples on the board, and everybody's score in a line."""
    scores = [
        f"{apples} by {'you' if agent == session.agent else f'agent {agent}'}"
        + ("" if session.moments[-1].in_play[agent] else " (out of play)")
        for agent, apples in enumerate(session.harvested)
    ]
    of_steps = f"turn {session.turn:,} of {session.game.rules.episode_steps:,}"
    return f"{of_steps}; {session.stock} apples on the board; harvested: {', '.join(scores)}"


def happened(session: Session, turn: StepOutput) -> Iterator[str]:
    """Yield what a turn brought the person, and who tagged whom."""
    me, tagged_by = session.agent, turn.tagged_by[0]
    if turn.harvest[0, me]:
        yield "you harvest an apple"
    if turn.fired[0, me] and not tagged_by[:, me].any():
        yield "your beam tags nobody out"
    for tagged, by in zip(*tagged_by.nonzero(), strict=True):
        whom = "you out" if tagged == me else f"agent {tagged} out"
        yield f"you tag {whom}" if by == me else f"agent {by} tags {whom}"


def play_in_terminal(session: Session, read_line: Callable[[], str] | None = None) -> None:
    """Play the episode: a line of keys is played key by key; `quit`, Ctrl-C or the end of input ends it.

    Args:
        read_line: returns a line with its newline, or "" at the end; by default that of standard input.
    """
    read_line = read_line or sys.stdin.readline
    boards = console(width=None if OUT.isatty() else 4 * session.game.map.width + 120)
    say(f"You are agent {session.agent}. Keys: {help_of(session.game)}; several in a line, then Enter.")
    say(f"Enter alone stays; {QUIT} ends.")
    while True:
        boards.print(board_text(session), soft_wrap=True)
        say(state(session))
        if session.has_ended or not _ask_and_play(session, read_line):
            break
    ending = "no apple is left" if session.stock == 0 else "time is over"
    say(f"The end: {ending if session.has_ended else f'stopped after turn {session.turn:,}'}.")
    for name, value in session.metrics().items():
        number = "undefined" if isnan(value) else f"{value:.4g}"
        say(f"{name:17s} {number:>9s}  {title(name)}")
    if not session.turn:
        say("No turn was played, so there is nothing to measure.")


def _ask_and_play(session: Session, read_line: Callable[[], str]) -> bool:
    """Play the next line whose keys are known; False where the person leaves."""
    while True:
        OUT.write(_PROMPT)
        OUT.flush()
        try:
            line = read_line()
        except KeyboardInterrupt:
            line = ""
        if not sys.stdin.isatty() or not line:
            say(line.rstrip("\n"))
        typed = line.strip() or "."
        if not line or typed == QUIT:
            return False
        unknown = [key for key in typed if KEYS.get(key, ("",))[0] not in session.game.actions]
        if not unknown:
            break
        say(f"key is {unknown[0]!r}; allowed: {help_of(session.game)}, or {QUIT}; nothing was played")
    for key in typed:
        for event in happened(session, session.act(KEYS[key][0])):
            say(f"turn {session.turn:,}: {event}")
        if session.has_ended:
            break
    return True


def board_text(session: Session) -> Text:
    """The board by rows: `A` an apple, `#` a wall, `~` and `H` a river's water and waste, `*` a beam, and
    each agent's number with its heading."""
    board, now = session.game.map, session.moments[-1]
    wide = len(str(session.game.agents - 1)) + 1
    cells: dict[tuple[int, int], tuple[str, Colour]] = {
        **dict.fromkeys(board.river, (maps.WATER, PALETTE[WATER])),
        **{cell: ("A", PALETTE[APPLE]) for cell, apple in zip(board.sites, now.stock, strict=True) if apple},
        **{
            (int(row), int(col)): (sign, PALETTE[kind])
            for kind, sign in ((WASTE, maps.WASTE), (BEAM, "*"), (CLEANING, "*"))
            for row, col in np.argwhere(now.board == kind)
        },
        **dict.fromkeys(board.walls, ("#" * wide, PALETTE[WALL])),
    }
    for agent, (row, col, heading) in enumerate(zip(now.row, now.col, now.heading, strict=True)):
        if now.in_play[agent]:
            cells[int(row), int(col)] = f"{agent}{SIGN_OF_HEADING[int(heading)]}", agent_colour(agent)
    text = Text()
    for row in range(board.height):
        for col in range(board.width):
            sign, (red, green, blue) = cells.get((row, col), (".", PALETTE[WALL]))
            is_last = col == board.width - 1
            text.append(sign if is_last else sign.ljust(wide), f"rgb({red},{green},{blue})")
        text.append("\n" if row < board.height - 1 else "")
    return text


def board_named(
    board: str, variant: Variant = "published", *, allow: Sequence[str] = ()
) -> tuple[Game, LoadedRun | None]:
    """A game, and the run that has it.

    Args:
        board: the name of a published board, the directory of a run, whose game is played, or a file with a
            drawing, see `cprl.maps.parse`, played by the published rules.
    """
    checked("variant", variant, Variant)
    check_board(board)
    if board in presets.names():
        return presets.game(board, variant=variant), None
    if variant != "published":
        raise refusal("variant", variant, f'"published" with {board}, which names no preset')
    path = Path(board)
    if path.is_dir():
        run = load(path, allow=allow)
        return commons_game(run), run
    return Game(map=maps.read(path), rules=Rules()), None


@working("preparing an episode")
def open_session(
    board: str,
    *,
    agent: int = 0,
    others: str | None = None,
    replica: int = 0,
    variant: Variant = "published",
    steps: int | None = None,
    seed: int = PLAY_SEED,
    decision: int | None = None,
    allow: Sequence[str] = (),
) -> Session:
    """An episode for a person and others.

    Args:
        others: the directory of a run, whose agents with the same indices play, or a scripted policy; by
            default the agents of the run that `board` names, else "greedy".
        replica: the index of the run's replica whose agents play.
        steps: turns of the episode at most, in place of those of the game.
        seed: of all random numbers; equal seeds and equal actions give equal episodes.
        decision: what the person decides in a game with votes or elections, 0 to `Game.decisions` - 1; None
            for a choice by chance, as of a scripted agent.
    """
    trust(*allow)
    game, run = board_named(board, variant)
    if steps is not None:
        game = replace(game, rules=replace(game.rules, episode_steps=steps))
    agent = checked("agent", agent, Annotated[int, Range(0, game.agents - 1)])
    others = others if others is not None else "greedy" if run is None else board
    if replica and others in SCRIPTED_POLICIES:
        raise ValueError(f'replica is {replica}, and others is "{others}"; allowed: with the agents of a run')
    specs = [agent_named(others, index, replica=replica, name="others") for index in range(game.agents)]
    specs[agent] = Scripted("random")
    if run is None:
        env = make_env(game, seed=seed)
    else:
        env = replace(run, experiment=replace(run.experiment, game=game)).env(seed=seed)
    population = Population(env, specs, seed=seed)
    return Session(env, population.policy(1), agent=agent, decision=decision)
