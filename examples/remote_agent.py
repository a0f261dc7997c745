"""How to let a program take a seat in a game that cprl host serves: python examples/remote_agent.py LINK.
Prints what it harvested."""

import asyncio
import base64
import random
import sys

import aiohttp
import numpy as np

# The messages are described in cprl.web.messages; nothing else here is of cprl, so any language will do.
APPLE = (0, 255, 0)
"""The colour of apples in an agent's window."""


def choose(window: np.ndarray) -> str:
    """Walk to the nearest apple in the window, uint8 [3, rows, columns]; the agent looks up from its last
    row."""
    rows, cols = np.nonzero((window == np.reshape(APPLE, (3, 1, 1))).all(0))
    if not rows.size:
        return random.choice(["forward", "forward", "forward", "turn_left", "turn_right"])
    ahead = window.shape[1] - 1 - rows
    aside = cols - window.shape[2] // 2
    nearest = np.argmin(ahead + abs(aside))
    if ahead[nearest]:
        return "forward"
    return "right" if aside[nearest] > 0 else "left"


async def play(link: str) -> None:
    """Take a seat, and play until the session ends."""
    server, _, token = link.partition("/#")
    async with aiohttp.ClientSession() as session:
        seat = await (await session.post(f"{server}/join", json={"token": token})).json()
        protocols = ("cprl", seat["seat_token"])
        async with session.ws_connect(f"{server}/socket", protocols=protocols) as socket:
            await socket.send_json({"type": "view", "view": "array"})
            shape: list[int] = []
            async for message in socket:
                news = message.json()
                if news["type"] == "welcome" and news["consent"]:
                    await socket.send_json({"type": "consent"})
                elif news["type"] == "round":
                    shape = news["observation_shape"]
                    await socket.send_json({"type": "ready"})
                elif news["type"] == "turn":
                    window = np.frombuffer(base64.b64decode(news["observation"]), np.uint8).reshape(shape)
                    action = {"type": "action", "action": choose(window[:3]), "number": news["turn"]}
                    await socket.send_json(action)
                elif news["type"] == "end":
                    harvest = news["rounds"][-1]["harvest"][news["names"].index("you")]
                    print(f"{seat['code']}: {harvest} apples in the last round")
                    return


if __name__ == "__main__":
    asyncio.run(play(sys.argv[1]))
