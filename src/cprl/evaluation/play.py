"""Plays an episode in which a person decides for one agent, in the terminal or through a pipe."""

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
from cprl.commons.world import StepOutput, WorldView
from cprl.envs.make_env import make_env
from cprl.envs.unwrap import commons_of
from cprl.evaluation.fresh import averages_in_words, board_now, fresh_seed, typical_replica
from cprl.evaluation.populations import agent_named, commons_game, refuse_trained_in
from cprl.experiment import presets
from cprl.measuring import social
from cprl.measuring.playing import Policy, turns
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
"""The action of each key, and its description."""
QUIT: Final = "quit"
HELP: Final = "?"
_ARROWS: Final = {"A": "w", "B": "s", "C": "e", "D": "q"}
"""The key for each arrow, by the last letter that a terminal sends: up, down, right, left."""
_ENDING_KEYS: Final = "\x1b\x04"
"""Esc and Ctrl-D, which end the episode."""
_SIGNS: Final = {
    APPLE: "A",
    WATER: maps.SIGN_OF["water"],
    WASTE: maps.SIGN_OF["waste"],
    BEAM: "*",
    CLEANING: "*",
}
_PROMPT: Final = "keys> "
_LINE_HELP: Final = f"Enter plays a line of them and alone stays, {HELP} prints them, {QUIT} ends"
"""The end of the help if keys are typed in lines."""
_SINGLE_KEY_HELP: Final = f"arrows step and turn, Enter stays, {HELP} prints them, Esc ends"
"""The end of the help if each key plays at once."""


def help_of(game: Game) -> str:
    """Return the keys of a game with their descriptions: "w step forward, s step back, ..."."""
    return ", ".join(f"{key} {name}" for key, (action, name) in KEYS.items() if action in game.actions)


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
        return [int(apples) for apples in self.moments[-1].harvested]

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


def state(session: Session) -> str:
    """Return a line with the turn, the apples on the board, and the score of each agent."""
    scores = []
    for agent, apples in enumerate(session.harvested):
        name = "you" if agent == session.agent else f"agent {agent}"
        out = "" if session.moments[-1].in_play[agent] else " (out of play)"
        scores.append(f"{apples} by {name}{out}")
    turn = f"turn {session.turn:,} of {session.game.rules.episode_steps:,}"
    return f"{turn}; {session.stock} apples on the board; harvested: {', '.join(scores)}"


def happened(session: Session, turn: StepOutput) -> Iterator[str]:
    """Yield sentences for the events of a turn: the person's harvest and shot, and who tagged whom."""
    person = session.agent
    tagged_by = turn.tagged_by[0]
    if turn.harvest[0, person]:
        yield "you harvest an apple"
    if turn.fired[0, person] and not tagged_by[:, person].any():
        yield "your beam tags nobody out"
    for tagged, shooter in zip(*tagged_by.nonzero(), strict=True):
        target = "you out" if tagged == person else f"agent {tagged} out"
        yield f"you tag {target}" if shooter == person else f"agent {shooter} tags {target}"


def play_in_terminal(session: Session, read_keys: Callable[[], str] | None = None) -> None:
    """Let a person play the episode.

    In a terminal each key plays at once. Through a pipe the keys of each line are played one after the other.

    Args:
        read_keys: returns a line of keys with its newline, or "" at the end; by default the typed keys.
    """
    if read_keys is not None:
        _play(session, read_keys, _LINE_HELP)
    elif sys.stdin.isatty():
        with _single_keys() as read_single_key:
            _play(session, read_single_key, _SINGLE_KEY_HELP)
    else:
        _play(session, sys.stdin.readline, _LINE_HELP)


def _play(session: Session, read_keys: Callable[[], str], help_end: str) -> None:
    """Play the episode and print the board, the score and, at the end, the metrics."""
    width = None if OUT.isatty() else 4 * session.game.map.width + 120
    boards = console(width=width)
    say(f"You are agent {session.agent}. {session.about_others}".rstrip())
    _print_keys(session, help_end)
    while True:
        boards.print(board_text(session), soft_wrap=True)
        say(state(session))
        if session.has_ended or not _ask_and_play(session, read_keys, help_end):
            break
    ending = f"stopped after turn {session.turn:,}"
    if session.has_ended:
        ending = "no apple is left" if session.stock == 0 else "time is over"
    say(f"The end: {ending}.")
    if session.has_ended and session.usual:
        apples = session.harvested[session.agent]
        say(f"You got {apples} apple{'' if apples == 1 else 's'}. {session.usual}")
    for name, value in session.metrics().items():
        number = "undefined" if isnan(value) else f"{value:.4g}"
        say(f"{name:17s} {number:>9s}  {title(name)}")
    if not session.turn:
        say("No turn was played, so there is nothing to measure.")


def _print_keys(session: Session, help_end: str) -> None:
    """Print the help in lines that break only between keys."""
    keys = f"Keys: {help_of(session.game)}, {help_end}."
    unbreakable = ", ".join(key.replace(" ", "\xa0") for key in keys.split(", "))
    width = console().width if OUT.isatty() else 80
    for line in wrap(unbreakable, width, break_on_hyphens=False):
        say(line.replace("\xa0", " "))


def _ask_and_play(session: Session, read_keys: Callable[[], str], help_end: str) -> bool:
    """Ask for keys and play them; return False if the person ends the episode."""
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
            _print_keys(session, help_end)
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
    """Make the terminal deliver each key when it is pressed, without showing it.

    Yield a function that returns the pressed keys.
    """
    if sys.platform == "win32":
        import msvcrt

        yield lambda: keys_of(msvcrt.getwch())
        return
    import termios
    import tty

    settings = termios.tcgetattr(sys.stdin)
    tty.setcbreak(sys.stdin, termios.TCSADRAIN)  # the default would discard keys that were typed already
    try:
        yield lambda: keys_of(os.read(sys.stdin.fileno(), 64).decode(errors="replace"))
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, settings)


def keys_of(pressed: str) -> str:
    """Return the keys that a terminal sent, with arrows as the keys that they stand for; "" for Esc."""
    keys = re.sub(r"\x1b[\[O]([ABCD])", lambda arrow: _ARROWS[arrow[1]], pressed)
    return "" if any(key in _ENDING_KEYS for key in keys) else keys


def board_text(session: Session) -> Text:
    """Return the board by rows, in colours.

    `A` is an apple, `#` a wall, `~` the water of a river and `H` its waste, `*` a beam, and `.` any other
    cell. An agent has its number and the sign of its heading.
    """
    board = session.moments[-1]
    cell_width = len(str(session.game.agents - 1)) + 1
    signs = {**_SIGNS, WALL: "#" * cell_width}
    agent_signs = {}
    for agent in np.flatnonzero(board.in_play):
        position = int(board.row[agent]), int(board.col[agent])
        agent_signs[position] = f"{agent}{SIGN_OF_HEADING[int(board.heading[agent])]}"
    text = Text()
    for cell, kind in np.ndenumerate(board.board):
        sign = agent_signs.get(cell, signs.get(int(kind), ".")).ljust(cell_width)
        if cell[1] == board.board.shape[1] - 1:
            sign = f"{sign.rstrip()}\n"
        red, green, blue = picture_colour(int(kind) or WALL)
        text.append(sign, f"rgb({red},{green},{blue})")
    text.right_crop()
    return text


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
    others = others if others is not None else "greedy" if run is None else board
    if replica and others in SCRIPTED_POLICIES:
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
        harvest = table.filter(pc.field("agent") == agent)["harvest"]
        apples.append(f"{pc.mean(harvest).as_py():,.0f}")
    trained, random = apples
    return f"On average trained agent {agent} gets {trained}, and {random} where all act at random."
