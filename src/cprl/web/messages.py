"""Messages between a hosted game and whoever takes a seat in it: a page in a browser, or any program.

All are JSON objects with a "type". One joins with the token behind the `#` of the link of `cprl host`:

    POST /join  {"token": TOKEN}  ->  {"seat_token": SECRET, "code": "K7QX"}
    409 {"type": "error", "why": "all 4 seats are taken"}; 403 for another token; 429 for too many requests

SECRET is that of the seat; {"token": TOKEN, "seat_token": SECRET} asks whether it still is, and takes another
seat if not. The socket carries it as its second subprotocol:
`new WebSocket("ws://HOST/socket", ["cprl", SECRET])`. A newer socket of a seat replaces an older one, which
is closed with the code 4001.

To the server come at most 1,024 bytes a message, and 20 messages a second, or two for each turn if those
are more; of a flood the socket is closed with the code 4008. Other fields than these are refused:

    {"type": "consent"}        to the text of "welcome", before anything else
    {"type": "ready"}          what is to be read before a round is read
    {"type": "action", "action": "forward", "number": 17}
                               one of the round's actions; the last one before a turn is played. `number`
                               comes back as "ack", so that one sees which action has been played
    {"type": "vote", "option": 1}
                               the index of one of the round's options, before its first turn
    {"type": "chat", "text": "..."}
                               1 to 200 printable characters to one's group, while a round is on
    {"type": "view", "view": "array"}
                               how one's turns are sent from now on: "array" or "text"

From the server come:

    welcome    group, agent, code, title, consent (the text, or null)
    stage      stage (consent, lobby, instructions, practice, playing, between, paused, end), here, ready,
               seats, round (0: practice), rounds, seconds (until it ends by itself, or null)
    round      what does not change in a round: round, rounds, rule, instructions (sentences), view,
               turns_a_second (null: a turn when all have chosen), episode_steps, names, actions, options (of
               the vote, or null), chat, observation_shape, window_colours, and
               the scene of the board: width, height, walls, sites, river, regions, colours, marks, palette; a
               cell is row * width + column
    turn       turn (0: before the first), harvest and income (of each agent; income null without
               institutions), stock, rule_in_force, in_play (whether one can act), ack; for who sees no board
               others' numbers are null in games without a scoreboard, the stock in those without a gauge;
               and one of
                 board        apples (hex, a bit a site), waste, cells, poses (heading + 4 in play + 8 broke a
                              rule), beams
                 window       base64 of the classes of the cells that one sees, a byte a cell, row by row
                 observation  base64 of ("agents", "observation") of `CommonsEnv`, uint8 of observation_shape
                 text         the window as lines of `cprl.pictures.decoding.SIGNS`
    chat       from, text
    vote       result: the title and the value in force of each ballot
    round_end  round, harvest, income, survival_steps, ended (in words)
    end        completion_code, names, rounds: of each rule, harvest, income, survival_steps, ended, and
               trained (harvest of an agent and survival_steps, means over replicas, and harvest_interval and
               survival_steps_interval, [low, high] or null for a single replica; or null)
    error      why: the message was no JSON, too large, unknown, too early or not allowed; nothing has changed
"""

import json
from dataclasses import dataclass
from typing import Any, Final, Literal, TypeAlias

from cprl.values import Natural, Value, build, short_repr
from cprl.web.hosting import ShortText
from cprl.web.scenes import compact_json

MOST_BYTES: Final = 1024
"""The largest message that is read."""


@dataclass(frozen=True)
class Join(Value, stored=False):
    """What one posts to get a seat, or to ask for the one that one has."""

    token: str
    seat_token: str | None = None


@dataclass(frozen=True)
class Consent(Value, stored=False):
    """A person consents to the text that was shown."""


@dataclass(frozen=True)
class Ready(Value, stored=False):
    """A person has read what is shown."""


@dataclass(frozen=True)
class Action(Value, stored=False):
    """The action for the coming turn, by its name, and the number that comes back with it."""

    action: str
    number: Natural


@dataclass(frozen=True)
class Choice(Value, stored=False):
    """The choice on the ballots of the coming round, as an index into its options."""

    option: Natural


@dataclass(frozen=True)
class Chat(Value, stored=False):
    """A line to one's group."""

    text: ShortText


@dataclass(frozen=True)
class Seeing(Value, stored=False):
    """The form of one's turns from now on."""

    view: Literal["array", "text"]


Message: TypeAlias = Consent | Ready | Action | Choice | Chat | Seeing
_KINDS: Final[dict[str, Any]] = {
    "consent": Consent,
    "ready": Ready,
    "action": Action,
    "vote": Choice,
    "chat": Chat,
    "view": Seeing,
}


def read(text: object) -> Message:
    """Read a message to the server.

    Raises:
        ValueError: for anything that is not one of the messages; says what is wrong with it.
    """
    table = read_object(text)
    name = table.pop("type", None)
    if not isinstance(name, str) or name not in _KINDS:
        raise ValueError(f"type is {short_repr(name)}; allowed: {', '.join(_KINDS)}")
    message: Message = build(_KINDS[name], table, name)
    return message


def read_object(text: object, most_bytes: int = MOST_BYTES) -> dict[str, Any]:
    """Return a JSON object of so many bytes at most; raise a ValueError for any other text."""
    if not isinstance(text, str):
        raise ValueError("the message is bytes; allowed: text")
    if len(text.encode(errors="replace")) > most_bytes:
        raise ValueError(f"the message is too large; allowed: {most_bytes:,} bytes")
    try:
        table = json.loads(text)
    except (ValueError, RecursionError):
        raise ValueError("the message is no JSON") from None
    if not isinstance(table, dict):
        raise ValueError("the message is no JSON object")
    return table


def write(name: str, **fields: Any) -> str:
    """Return a message from the server as text."""
    return compact_json({"type": name, **fields})
