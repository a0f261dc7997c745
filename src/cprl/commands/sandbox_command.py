"""`cprl sandbox`: a page to try boards and rules on, for people who do not program."""

from contextlib import closing, suppress
from pathlib import Path

from cprl.commands.play_stored import begin_playing
from cprl.system.defaults import SANDBOX_EPISODES
from cprl.system.output import say
from cprl.system.working import working


def sandbox(*, port: int = 0, out: Path | None = None, episodes: int = SANDBOX_EPISODES) -> None:
    """Open a page with sliders for people who do not program: rules, boards, scripted agents, trainings.

    Args:
        port: Of the page, which is on 127.0.0.1 alone; 0 for any that is free.
        out: Where trainings are kept; by default they are gone when the sandbox is closed.
        episodes: Of a training.
    """
    begin_playing(0)

    with working("starting"):
        import asyncio

        from cprl.web.sandbox import Sandbox, serve_sandbox

    with closing(Sandbox(out, episodes=episodes)) as served, suppress(KeyboardInterrupt):
        asyncio.run(serve_sandbox(served, port, lambda address: say(f"{address} is open until Ctrl-C")))
    say("closed")
