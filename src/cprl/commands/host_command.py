"""`cprl host`: let people play, among each other and among trained or scripted agents, in their browsers."""

from contextlib import closing, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import tyro

from cprl.commands.flags import BoardArgument, institutions_named
from cprl.commands.play_stored import begin_playing
from cprl.commons.named_games import check_game_source
from cprl.system.working import working
from cprl.web.hosting import Hosting

if TYPE_CHECKING:
    from cprl.institutions import Institution

_PACKAGES: Final = ("aiohttp", "segno")
_TABLE: Final = ".json"
_HOSTING: Final = Hosting()


def host(
    board: BoardArgument,
    /,
    *,
    hosting: Annotated[Hosting, tyro.conf.arg(name="")] = _HOSTING,
    rounds: tuple[str, ...] = (),
    consent: Path | None = None,
    out: Path = Path("session"),
    port: int = 8300,
    lan: bool = False,
) -> None:
    """Host a game that people play in their browsers, among each other and other agents, and keep what they
    do.

    It prints a link, and a QR code of it, by which each person gets an agent. With the same words and --out a
    session that was stopped goes on where it was.

    Args:
        rounds: The treatments in their order: none; institutions by their names, quota+monitoring or
            quota:share=0.5,fine=1; vote, on a tax; or a file .json with a list of institutions. By default
            one round of the game as it is.
        consent: A file with the text that people consent to before they play.
        out: The folder of the session; each of its rounds is a run.
        port: Of the page; 0 for any that is free.
        lan: Let other machines of the local network join, not this one alone.
    """
    for package in _PACKAGES:
        if find_spec(package) is None:
            raise ModuleNotFoundError(
                f'cprl host needs {package}, which is not installed; run pip install "cprl[web]"',
                name=package,
            )
    check_game_source(board)
    treatments = tuple((Path(word).name.removesuffix(_TABLE), _institutions(word)) for word in rounds)
    text = None if consent is None else consent.read_text(encoding="utf-8")
    begin_playing(hosting.seed)

    import asyncio

    from cprl.web.hall import Hall
    from cprl.web.host import serve_session
    from cprl.web.session import HostedSession

    session = HostedSession(game=board, rounds=treatments, consent=text, **vars(hosting))
    with working("preparing all rounds"):
        hall = Hall(session, out)
    with closing(hall), suppress(KeyboardInterrupt):
        asyncio.run(serve_session(hall, port=port, in_room=lan))


def _institutions(word: str) -> "tuple[Institution, ...]":
    """Return the institutions of a treatment."""
    from cprl.institutions import Tax, Vote

    if word == "vote":
        return (Vote(on=Tax()),)
    return institutions_named([word] if word.endswith(_TABLE) else word.split("+"), "--rounds")
