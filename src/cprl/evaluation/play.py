"""Play: an episode in which a person decides for one agent, in the terminal, also through a pipe."""

import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from math import isnan
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from rich.text import Text
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from cprl import arguments, keys
from cprl.commons.colours import APPLE, BEAM, PALETTE, WALL, Colour, agent_colour
from cprl.commons.game import Game
from cprl.commons.maps import SIGN_OF_HEADING
from cprl.commons.world import Shown
from cprl.envs.make_env import make_env
from cprl.envs.unwrap import commons_of
from cprl.evaluation.lanes import Policy, Turns
from cprl.evaluation.populations import agent_named, board_named
from cprl.measuring import social
from cprl.measuring.names import title
from cprl.policies.scripted import SCRIPTED_POLICIES
from cprl.population import Scripted
from cprl.presets import Variant
from cprl.system.output import OUT, console, say
from cprl.training.agents import Population

LETTERS: Final = {
    "w": "forward",
    "s": "backward",
    "a": "left",
    "d": "right",
    "q": "turn_left",
    "e": "turn_right",
    "f": "beam",
    ".": "stay",
}

ACTION_NAMES: Final = {
    "forward": "step forward",
    "backward": "step back",
    "left": "step left",
    "right": "step right",
    "turn_left": "turn left",
    "turn_right": "turn right",
    "beam": "fire the beam",
    "stay": "stay",
}


def keys_of(game: Game) -> dict[str, str]:
    """The letters that a game knows, and their actions."""
    return {letter: action for letter, action in LETTERS.items() if action in game.actions}


def help_of(game: Game) -> str:
    """All letters in a line: "w step forward, s step back, ..."."""
    return ", ".join(f"{letter} {ACTION_NAMES[action]}" for letter, action in keys_of(game).items())


@dataclass(frozen=True, kw_only=True, eq=False)
class TurnPlayed:
    """What one turn brought."""

    harvest: NDArray[np.float32]
    """float32 [N], apples that each agent harvested in this turn."""
    fired: NDArray[np.bool_]
    """bool [N], who fired."""
    tagged_by: NDArray[np.bool_]
    """bool [N, N]; row: the agent tagged out, column: by whom."""


class Session:
    """The episode, turn by turn.

    Args:
        env: one world of a `CommonsEnv`, with or without transforms; it is reset.
        others: writes the actions of all agents; that of the person's agent is replaced.
        decision: what it decides, see `Game.decisions`; None for what `others` write.
    """

    def __init__(self, env: EnvBase, others: Policy, *, agent: int = 0, decision: int | None = None) -> None:
        commons = commons_of(env)
        if commons is None:
            raise ValueError(f"env is a {type(env).__name__}; allowed: a CommonsEnv, which has a board")
        self._commons, self._others = commons, others
        self.game: Game = commons.game
        self.agent = arguments.integer("agent", agent, 0, self.game.agents - 1)
        """The index of the person's agent."""
        self._decision = None if decision is None else self._decided(decision)
        self._action = 0
        self._turns = Turns(env, self._choose)
        self._harvests: list[Tensor] = []
        self._in_play: list[Tensor] = []
        self.moments: list[Shown] = [self._now()]
        """The board as the episode began, then after each turn."""

    @property
    def turn(self) -> int:
        """Turns played."""
        return len(self.moments) - 1

    @property
    def has_ended(self) -> bool:
        """Whether the episode has ended: no apple is left and none can grow, or time is over."""
        return self._turns.has_ended

    @property
    def is_in_play(self) -> bool:
        """Whether the person's next action will count: a tagged agent is out of play for some turns."""
        return bool(self.moments[-1].in_play[self.agent])

    @property
    def harvested(self) -> list[int]:
        """Apples that each agent has harvested so far."""
        return [int(apples) for apples in self.moments[-1].harvested]

    @property
    def stock(self) -> int:
        """Apples on the board."""
        return int(self.moments[-1].stock.sum(dtype=np.int64))

    def act(self, action: str) -> TurnPlayed:
        """Plays a turn: the person's agent takes this action, the others choose theirs."""
        arguments.choice("action", action, self.game.actions)
        self._action = self.game.actions.index(action)
        batch = self._turns.play()
        following = batch["next"]
        self._harvests.append(following[keys.HARVEST])
        self._in_play.append(batch[keys.IN_PLAY])
        self.moments.append(self._now())
        output = self._commons.output
        return TurnPlayed(
            harvest=output.harvest[0].copy(),
            fired=output.fired[0].copy(),
            tagged_by=output.tagged_by[0].copy(),
        )

    def metrics(self) -> dict[str, float]:
        """The social metrics of the turns played so far, those of `cprl.measuring.social.summary` and
        stock_left; NaN where undefined, empty before the first turn."""
        if not self._harvests:
            return {}
        measured = social.summary(torch.cat(self._harvests), torch.cat(self._in_play))
        return {**{name: float(value) for name, value in measured.items()}, "stock_left": float(self.stock)}

    def _choose(self, moment: TensorDictBase) -> TensorDictBase:
        chosen = self._others(moment)
        actions = chosen[keys.ACTION].clone()
        actions[0, self.agent] = self._action
        chosen[keys.ACTION] = actions
        if self._decision is not None:
            decisions = chosen[keys.DECISION].clone()
            decisions[0, self.agent] = self._decision
            chosen[keys.DECISION] = decisions
        return chosen

    def _decided(self, decision: int) -> int:
        options = self.game.decisions
        if not options:
            raise arguments.refusal("decision", decision, "None: agents decide nothing in this game")
        return arguments.integer("decision", decision, 0, options - 1)

    def _now(self) -> Shown:
        """The board, without what agents observe."""
        shown = self._commons.worlds.show(self._commons.output)
        return shown._replace(observation=shown.observation[:0])


def state(session: Session) -> str:
    """The turn, the apples on the board, and everybody's score."""
    scores = [
        f"{apples} by {'you' if agent == session.agent else f'agent {agent}'}{_out(session, agent)}"
        for agent, apples in enumerate(session.harvested)
    ]
    of_steps = f"turn {session.turn:,} of {session.game.rules.episode_steps:,}"
    return f"{of_steps}; {session.stock} apples on the board; harvested: {', '.join(scores)}"


def _out(session: Session, agent: int) -> str:
    return "" if session.moments[-1].in_play[agent] else " (out of play)"


def happened(session: Session, turn: TurnPlayed) -> Iterator[str]:
    """What a turn brought the person, and who tagged whom."""
    me = session.agent
    if turn.harvest[me]:
        yield "you harvest an apple"
    if turn.fired[me] and not turn.tagged_by[:, me].any():
        yield "your beam tags nobody out"
    for tagged, by in zip(*turn.tagged_by.nonzero(), strict=True):
        whom = "you out" if tagged == me else f"agent {tagged} out"
        yield f"you tag {whom}" if by == me else f"agent {by} tags {whom}"


def ending(session: Session) -> str:
    """Why it is over, if it is."""
    if not session.has_ended:
        return f"stopped after turn {session.turn:,}"
    return "no apple is left" if session.stock == 0 else "time is over"


def results_text(session: Session) -> str:
    """Return the social metrics of the turns played, a line each: name, value, words and unit."""
    lines = [f"{name:17s} {_number(value):>9s}  {title(name)}" for name, value in session.metrics().items()]
    return "\n".join(lines) or "No turn was played, so there is nothing to measure."


def _number(value: float) -> str:
    return "undefined" if isnan(value) else f"{value:.4g}"


QUIT: Final = "quit"
_PROMPT: Final = "keys> "


def play_in_terminal(session: Session, read_line: Callable[[], str] | None = None) -> None:
    """Plays the episode: a line of keys is played key by key; `quit`, Ctrl-C or the end of input ends it.

    Args:
        read_line: returns a line with its newline, or "" at the end; by default that of standard input.
    """
    read_line = read_line or sys.stdin.readline
    shown = console(width=None if OUT.isatty() else 4 * session.game.map.width + 120)
    say(f"You are agent {session.agent}. Keys: {help_of(session.game)}; several in a line, then Enter.")
    say(f"Enter alone stays; {QUIT} ends.")
    while True:
        shown.print(board_text(session), soft_wrap=True)
        say(state(session))
        if session.has_ended or not _ask_and_play(session, read_line):
            break
    say(f"The end: {ending(session)}.")
    say(results_text(session))


def _ask_and_play(session: Session, read_line: Callable[[], str]) -> bool:
    """Plays the next line whose keys are known; False where the person leaves."""
    while True:
        line = _ask(read_line)
        if line is None or line.strip() == QUIT:
            return False
        if _play_line(session, line.strip() or "."):
            return True


def _ask(read_line: Callable[[], str]) -> str | None:
    """The next line of the input, which is shown where no terminal does; None at its end and for Ctrl-C."""
    OUT.write(_PROMPT)
    OUT.flush()
    try:
        line = read_line()
    except KeyboardInterrupt:
        line = ""
    if not sys.stdin.isatty() or not line:
        say(line.rstrip("\n"))
    return line or None


def _play_line(session: Session, line: str) -> bool:
    """Plays a line of keys, or none of it where one is unknown; whether it was played."""
    actions = keys_of(session.game)
    unknown = next((key for key in line if key not in actions), None)
    if unknown is not None:
        say(f"key is {unknown!r}; allowed: {help_of(session.game)}, or {QUIT}; nothing was played")
        return False
    for key in line:
        for event in happened(session, session.act(actions[key])):
            say(f"turn {session.turn:,}: {event}")
        if session.has_ended:
            break
    return True


def board_text(session: Session) -> Text:
    """The board by rows: `A` an apple, `#` a wall, `*` a beam, and each agent's number with its heading."""
    board, now = session.game.map, session.moments[-1]
    wide = len(str(session.game.agents - 1)) + 1
    cells: dict[tuple[int, int], tuple[str, Colour]] = {
        **{cell: ("A", PALETTE[APPLE]) for cell, apple in zip(board.sites, now.stock, strict=True) if apple},
        **{(int(row), int(col)): ("*", PALETTE[BEAM]) for row, col in np.argwhere(now.board == BEAM)},
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
        others: the directory of a run, whose agents with the same indices play, or a scripted policy; by
            default the agents of the run that `board` names, else "greedy".
        replica: the index of the run's replica whose agents play.
        steps: turns of the episode at most, in place of those of the game.
        seed: of all random numbers; equal seeds and equal actions give equal episodes.
        decision: what the person decides in a game with votes or elections, 0 to `Game.decisions` - 1; None
            for a choice by chance, as of a scripted agent.
    """
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
