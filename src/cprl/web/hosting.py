"""Hosting: how a hosted game goes, apart from the game itself; the flags of `cprl host` are its fields."""

from dataclasses import dataclass
from typing import Annotated, Final, Literal

from cprl.system.defaults import PLAY_SEED
from cprl.values import Natural, Positive, Range, Seed, Value, Where

STAY: Final = "stay"
TRAINED: Final = "trained"
ShortText = Annotated[
    str,
    Where(
        lambda text: bool(text.strip()) and len(text) <= 200 and text.isprintable(),
        "1 to 200 printable characters",
    ),
]


@dataclass(frozen=True, kw_only=True)
class Hosting(Value, stored=False, called="session"):
    """How people play, among whom, and what they see; see `cprl.web.session.HostedSession`."""

    people: Annotated[int, Range(1, 100)] = 4
    """People in each group, who are its first agents."""
    groups: Annotated[int, Range(1, 100)] = 1
    """Groups that play side by side, each in a world of its own."""
    agents: tuple[str, ...] = ()
    """The other agents of each group, a word each: trained, greedy, sustainable, random, territorial,
    aggressive or pacifist."""
    runs: tuple[str, ...] = ()
    """Directories of runs whose agents may play as "trained", beside the run that is the game: in each round
    those of the first run whose agents can play it."""
    turns: Positive | None = None
    """Turns of a round at most; by default as many as the game has."""
    turns_a_second: Annotated[float, Range(0, 60)] = 8.0
    """The pace; 0 for a turn when all have chosen."""
    choice_seconds: Annotated[float, Range(0.1, 3600)] = 20.0
    """How long people may take to choose, with a pace of 0."""
    pause_seconds: Annotated[float, Range(0, 3600)] = 60.0
    """How long people may read before a round; it begins earlier if all are ready."""
    practice_turns: Natural = 60
    """Turns of a practice round, which is not kept; 0 for none."""
    view: Literal["board", "window"] = "board"
    """What people see: the whole board, or what an agent in their place observes."""
    chat: bool = False
    """Whether people may write to their group; they also may in a game with signals."""
    absent: str = STAY
    """What the agent of a person who has left does: stay, or one of the scripted policies."""
    title: ShortText = "A commons"
    """The title of the page."""
    seed: Seed = PLAY_SEED
    """The seed of all chance; each round plays with the next one."""
