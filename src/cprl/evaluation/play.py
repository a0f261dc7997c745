"""Play: an episode in which a person decides for one agent, in the terminal, also through a pipe."""

import os
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from math import isnan
from pathlib import Path
from textwrap import wrap
from typing import Annotated, Final

import numpy as np
import pyarrow.compute as pc
import torch
from rich.text import Text
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from cprl import keys
from cprl.commons import maps
from cprl.commons.cells import APPLE, BEAM, CLEANING, WALL, WASTE, WATER
from cprl.commons.game import Game
from cprl.commons.maps import SIGN_OF_HEADING
from cprl.commons.published import Variant, check_board
from cprl.commons.rules import Rules
from cprl.commons.world import Shown, StepOutput
from cprl.envs.make_env import make_env
from cprl.envs.unwrap import commons_of
from cprl.evaluation.fresh import averages_in_words, board_now, fresh_seed, typical_replica
from cprl.evaluation.lanes import agent_named, commons_game, refuse_trained_in
from cprl.experiment import presets
from cprl.measuring import social
from cprl.measuring.evaluate import Policy, turns
from cprl.measuring.registry import title
from cprl.pictures.colours import picture_colour
from cprl.policies.scripted import SCRIPTED_POLICIES
from cprl.population import Scripted
from cprl.runs.episodes import read_rows
from cprl.system.defaults import PLAY_SEED
from cprl.system.output import OUT, console, say
from cprl.system.working import working
from cprl.training.agents import Population
from cprl.training.stored import LoadedRun, load
from cprl.values import Range, checked, refusal

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
HELP: Final = "?"
_ARROWS: Final = {"A": "w", "B": "s", "C": "e", "D": "q"}
"""The key for each arrow, by the last letter that a terminal sends: up, down, right, left."""
_ENDING: Final = "\x1b\x04"
"""Esc, and the end of a text."""
_SIGNS: Final = {APPLE: "A", WATER: maps.WATER, WASTE: maps.WASTE, BEAM: "*", CLEANING: "*"}
_PROMPT: Final = "keys> "
_BY_LINE: Final = f"Enter plays a line of them and alone stays, {HELP} prints them, {QUIT} ends"
_BY_KEY: Final = f"arrows step and turn, Enter stays, {HELP} prints them, Esc ends"


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

    about_others: str = ""
    """Who the others are, in sentences."""
    usual: str = ""
    """What agents get in whole episodes of this game, in a sentence; "" where that is not known."""

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
        self.moments: list[Shown] = [board_now(self._commons)]
        """The board as the episode began, then after each turn."""

    @property
    def turn(self) -> int:
        return len(self.moments) - 1

    @property
    def has_ended(self) -> bool:
        """Whether the episode has ended: no apple is left and none can grow, or time is over."""
        return bool(self._played) and bool(self._played[-1]["next", keys.DONE].any())

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
        if self.has_ended:
            raise ValueError("the episode has ended; allowed: turns up to its end")
        self._action = self.game.actions.index(action)
        self._played.append(next(self._turns))
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
    me = session.agent
    tagged_by = turn.tagged_by[0]
    if turn.harvest[0, me]:
        yield "you harvest an apple"
    if turn.fired[0, me] and not tagged_by[:, me].any():
        yield "your beam tags nobody out"
    for tagged, by in zip(*tagged_by.nonzero(), strict=True):
        whom = "you out" if tagged == me else f"agent {tagged} out"
        yield f"you tag {whom}" if by == me else f"agent {by} tags {whom}"


def play_in_terminal(session: Session, read_keys: Callable[[], str] | None = None) -> None:
    """Play the episode; in a terminal each key plays at once, through a pipe a line of keys one by one.

    Args:
        read_keys: returns a line of keys with its newline, or "" at the end; by default what is typed.
    """
    if read_keys is not None:
        _play(session, read_keys, _BY_LINE)
    elif sys.stdin.isatty():
        with _single_keys() as pressed:
            _play(session, pressed, _BY_KEY)
    else:
        _play(session, sys.stdin.readline, _BY_LINE)


def _play(session: Session, read_keys: Callable[[], str], more: str) -> None:
    boards = console(width=None if OUT.isatty() else 4 * session.game.map.width + 120)
    say(f"You are agent {session.agent}. {session.about_others}".rstrip())
    _say_keys(session, more)
    while True:
        boards.print(board_text(session), soft_wrap=True)
        say(state(session))
        if session.has_ended or not _ask_and_play(session, read_keys, more):
            break
    ending = "no apple is left" if session.stock == 0 else "time is over"
    say(f"The end: {ending if session.has_ended else f'stopped after turn {session.turn:,}'}.")
    if session.has_ended and session.usual:
        apples = session.harvested[session.agent]
        say(f"You got {apples} apple{'' if apples == 1 else 's'}. {session.usual}")
    for name, value in session.metrics().items():
        number = "undefined" if isnan(value) else f"{value:.4g}"
        say(f"{name:17s} {number:>9s}  {title(name)}")
    if not session.turn:
        say("No turn was played, so there is nothing to measure.")


def _say_keys(session: Session, more: str) -> None:
    """Print the keys in lines that break between keys alone."""
    keys = f"Keys: {help_of(session.game)}, {more}."
    joined = ", ".join(key.replace(" ", "\xa0") for key in keys.split(", "))
    width = console().width if OUT.isatty() else 80
    for line in wrap(joined, width, break_on_hyphens=False):
        say(line.replace("\xa0", " "))


def _ask_and_play(session: Session, read_keys: Callable[[], str], more: str) -> bool:
    """Play the next keys that are known; False where the person leaves."""
    while True:
        OUT.write(_PROMPT)
        OUT.flush()
        try:
            keys = read_keys()
        except KeyboardInterrupt:
            keys = ""
        say(keys.rstrip("\n"))
        typed = keys.strip() or "."
        if not keys or typed == QUIT:
            return False
        if typed == HELP:
            _say_keys(session, more)
            continue
        unknown = [key for key in typed if KEYS.get(key, ("",))[0] not in session.game.actions]
        if not unknown:
            break
        say(f"key is {unknown[0]!r}; allowed: {help_of(session.game)}; nothing was played")
    for key in typed:
        for event in happened(session, session.act(KEYS[key][0])):
            say(f"turn {session.turn:,}: {event}")
        if session.has_ended:
            break
    return True


@contextmanager
def _single_keys() -> Iterator[Callable[[], str]]:
    """Make the terminal hand over keys as they are pressed, without showing them."""
    if sys.platform == "win32":
        import msvcrt

        yield lambda: keys_of(msvcrt.getwch())
        return
    import termios
    import tty

    before = termios.tcgetattr(sys.stdin)
    tty.setcbreak(sys.stdin, termios.TCSADRAIN)  # by default what is typed already would be lost
    try:
        yield lambda: keys_of(os.read(sys.stdin.fileno(), 64).decode(errors="replace"))
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)


def keys_of(pressed: str) -> str:
    """Return the keys of what a terminal sent: arrows step and turn; "" for Esc, and if nothing was sent."""
    keys = re.sub(r"\x1b[\[O]([ABCD])", lambda arrow: _ARROWS[arrow[1]], pressed)
    return "" if any(key in _ENDING for key in keys) else keys


def board_text(session: Session) -> Text:
    """Return the board by rows: `A` an apple, `#` a wall, `~` and `H` a river's water and waste, `*` a beam,
    and each agent's number with its heading."""
    now = session.moments[-1]
    wide = len(str(session.game.agents - 1)) + 1
    signs = {**_SIGNS, WALL: "#" * wide}
    agents = {
        (int(now.row[agent]), int(now.col[agent])): f"{agent}{SIGN_OF_HEADING[int(now.heading[agent])]}"
        for agent in np.flatnonzero(now.in_play)
    }
    text = Text()
    for cell, kind in np.ndenumerate(now.board):
        sign = agents.get(cell, signs.get(int(kind), "."))
        red, green, blue = picture_colour(int(kind) or WALL)
        is_last = cell[1] == now.board.shape[1] - 1
        text.append(f"{sign}\n" if is_last else sign.ljust(wide), f"rgb({red},{green},{blue})")
    text.right_crop()
    return text


def board_named(board: str, variant: Variant = "published") -> tuple[Game, LoadedRun | None]:
    """Return a game, and the run that has it.

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
        run = load(path)
        return commons_game(run), run
    return Game(map=maps.read(path), rules=Rules()), None


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
    """Begin an episode for a person and others.

    Args:
        others: the directory of a run, whose agents with the same indices play, or a scripted policy; by
            default the agents of the run that `board` names, else "greedy".
        replica: the index of the run's replica whose agents play; by default a typical one, see
            `cprl.evaluation.fresh.typical_replica`.
        steps: turns of the episode at most, in place of those of the game.
        seed: of all random numbers, none that the others were trained with; by default 40011, or the next
            with which they were not. Equal seeds and equal actions give equal episodes.
        decision: what the person decides in a game with votes or elections, 0 to `Game.decisions` - 1; None
            for a choice by chance, as of a scripted agent.
    """
    game, run = board_named(board, variant)
    is_whole = steps is None and others in (None, board)
    if steps is not None:
        game = replace(game, rules=replace(game.rules, episode_steps=steps))
    agent = checked("agent", agent, Annotated[int, Range(0, game.agents - 1)])
    others = others if others is not None else "greedy" if run is None else board
    if replica and others in SCRIPTED_POLICIES:
        raise ValueError(f'replica is {replica}, and others is "{others}"; allowed: with the agents of a run')
    stored = _run_of(others, board, run)
    runs = [] if stored is None else [stored]
    if seed is None:
        seed = fresh_seed(runs, PLAY_SEED)
    refuse_trained_in(seed, runs)
    if replica is None and stored is not None:
        replica = typical_replica(stored)
    specs = [agent_named(others, index, replica=replica or 0, name="others") for index in range(game.agents)]
    specs[agent] = Scripted("random")
    if run is None:
        env = make_env(game, seed=seed)
    else:
        env = replace(run, experiment=replace(run.experiment, game=game)).env(seed=seed)
    population = Population(env, specs, seed=seed)
    session = Session(env, population.policy(1), agent=agent, decision=decision)
    if stored is not None:
        known = averages_in_words(stored)
        session.about_others = f"The others are of replica {replica}. {known}".rstrip()
        session.usual = _usual(stored, agent) if is_whole else ""
    return session


def _run_of(others: str, board: str, run: LoadedRun | None) -> LoadedRun | None:
    """Return the run whose agents play; None for scripted ones, and where there is none."""
    if others == board:
        return run
    return load(others) if others not in SCRIPTED_POLICIES and Path(others).is_dir() else None


def _usual(run: LoadedRun, agent: int) -> str:
    """Say what an agent gets on average in the run's own evaluation, trained and at random; "" where that is
    not known."""
    apples = []
    for policy in ("trained", "random"):
        path = run.path / "evaluation" / f"{policy}.parquet"
        table = read_rows(path) if run.networks and path.is_file() else None
        if table is None or "harvest" not in table.column_names:
            return ""
        harvest = table.filter(pc.field("agent") == agent)["harvest"]
        apples.append(f"{pc.mean(harvest).as_py():,.0f}")
    trained, random = apples
    return f"On average trained agent {agent} gets {trained}, and {random} where all act at random."
