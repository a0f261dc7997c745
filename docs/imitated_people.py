"""Programs that imitate people of three kinds take all seats of a hosted game that are free.

    cprl host commons --people 4 --groups 5 --rounds none quota --practice-turns 0 --out sessions/careful
    python docs/imitated_people.py LINK careful

They are no model of people: they show what tables and films of people look like. All see an agent's window.

- greedy: takes the nearest apple.
- careful: takes the nearest apple that has three others within two cells, so that it grows back.
- absent-minded: as greedy, but looks away two turns of three, and every tenth time turns about.
"""

import asyncio
import json
import random
from typing import Final, Literal

import aiohttp
import tyro

Kind = Literal["careful", "greedy", "absent-minded"]
NEIGHBOURS: Final = 3
RADIUS: Final = 2
WANDERING: Final = ("forward", "forward", "forward", "turn_left", "turn_right")


def choose(window: str, kind: Kind, rng: random.Random) -> str | None:
    """Return what a person does who sees a window as text; None for nothing.

    Args:
        window: a line for each row; the person stands in the middle of the last one, and looks up.
        kind: of the person.
        rng: all that is chance.
    """
    if kind == "absent-minded":
        if rng.random() < 2 / 3:
            return None
        if rng.random() < 0.1:
            return "turn_left"
    rows = window.split("\n")
    apples = {
        (len(rows) - 1 - row, col - len(line) // 2)
        for row, line in enumerate(rows)
        for col, sign in enumerate(line)
        if sign == "A"
    }
    wanted = [apple for apple in apples if kind != "careful" or _neighbours(apple, apples) >= NEIGHBOURS]
    if not wanted:
        return rng.choice(WANDERING)
    ahead, aside = min(wanted, key=lambda apple: (abs(apple[0]) + abs(apple[1]), apple))
    step = "forward" if ahead else ("right" if aside > 0 else "left")
    if kind == "careful" and _lands_on(step, apples - {*wanted}):
        return "turn_left"
    return step


def _neighbours(apple: tuple[int, int], apples: set[tuple[int, int]]) -> int:
    return sum(0 < abs(apple[0] - other[0]) + abs(apple[1] - other[1]) <= RADIUS for other in apples)


def _lands_on(step: str, cells: set[tuple[int, int]]) -> bool:
    return {"forward": (1, 0), "right": (0, 1), "left": (0, -1)}[step] in cells


async def play(link: str, kind: Kind, seed: int) -> bool:
    """Take a seat and play until the session ends; return False if all seats are taken."""
    rng = random.Random(seed)
    server, _, token = link.partition("/#")
    async with aiohttp.ClientSession() as session:
        answer = await session.post(f"{server}/join", json={"token": token})
        if answer.status == 409:
            return False
        answer.raise_for_status()
        seat = await answer.json()
        async with session.ws_connect(f"{server}/socket", protocols=("cprl", seat["seat_token"])) as socket:
            await socket.send_json({"type": "consent"})
            await socket.send_json({"type": "view", "view": "text"})
            async for message in socket:
                news = json.loads(message.data)
                if news["type"] == "round":
                    await socket.send_json({"type": "ready"})
                elif news["type"] == "turn":
                    action = choose(news["text"], kind, rng) if "text" in news else None
                    if action is not None:
                        await socket.send_json({"type": "action", "action": action, "number": news["turn"]})
                elif news["type"] == "end":
                    return True
            raise ConnectionError(f"the server closed the socket before the end, code {socket.close_code}")


async def take_all(link: str, kinds: tuple[Kind, ...]) -> int:
    """Take all free seats, by kind in turn; return how many there were once the session has ended."""
    playing: list[asyncio.Task[bool]] = []
    while not any(task.done() and not task.result() for task in playing):
        number = len(playing)
        playing.append(asyncio.create_task(play(link, kinds[number % len(kinds)], number)))
        await asyncio.sleep(0.2)
    return sum(await asyncio.gather(*playing))


def main(link: str, kinds: tuple[Kind, ...] = ("careful", "greedy", "absent-minded"), /) -> None:
    """Play until the session ends.

    Args:
        link: that `cprl host` prints.
        kinds: of the people, in turn.
    """
    print(f"{asyncio.run(take_all(link, kinds))} seats played to the end")


if __name__ == "__main__":
    tyro.cli(main)
