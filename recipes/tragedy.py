"""The tragedy of the commons in a minute: agents who learn end worse off than agents who do not.

    python recipes/tragedy.py --watch serve --linger       4 replicas of 16 worlds, 160,000 steps

Four independent DQN agents on `commons`, by the published rules. Each replica learns from sixteen worlds at
once, on a schedule ten times shorter than the published one, which recipes/commons.py has.
Copy this file and change it: another map, rule, network or loss is one line.
"""

from dataclasses import replace
from pathlib import Path

import cprl
from cprl import presets
from cprl.algorithms import DQN
from cprl.population import Learning
from cprl.system.output import quote_command, say
from cprl.system.shipped import cprl_command

WORLDS = 16
SETTINGS = replace(
    presets.dqn_settings("commons"),
    learning_rate=1e-3,
    gamma=0.97,
    batch_size=64,
    steps_per_update=WORLDS,  # so one update a turn
    epsilon_decay_steps=100_000,
    target_every_updates=250,
)
"""The published settings but for what is said here."""

NEXT = """\
This was a short schedule. The published one, 8 replicas of 4,800 episodes, takes hours:
    {cprl} run commons
Three things to try next:
    {cprl} film {run} --out tragedy.gif
        one episode of the trained agents as a film
    {cprl} play {run}
        play among them yourself
    {cprl} run tragedy --game.rules.freeze-steps 100 --watch serve --linger
        another rule: who is hit by the beam stays out four times as long"""


def experiment() -> cprl.Experiment:
    """Train four independent DQN agents on `commons`, on a short schedule."""
    return cprl.Experiment(
        name="tragedy",
        game=presets.game("commons"),
        agents=(Learning(DQN(settings=SETTINGS)),) * 4,
        steps=160_000,
        replicas=4,
        worlds=WORLDS,
        evaluation_episodes=50,
    )


def print_next(run: Path) -> None:
    """Print what to try next."""
    say(NEXT.format(run=quote_command([str(run)]), cprl=quote_command(cprl_command())))


if __name__ == "__main__":
    cprl.recipe_main(experiment, at_end=print_next)
