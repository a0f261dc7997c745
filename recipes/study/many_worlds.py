"""What does more experience change? PPO and DQN on `commons` in 1, 16 and 256 worlds.

    python recipes/study/many_worlds.py --jobs 1

Half a million steps of each replica, whichever the number of worlds; "as long" has so many steps of 256
worlds as take about the time of half a million of one; "1e8" is PPO as run, of one epoch, for a hundred
million steps (`--only "PPO, as run, 256 worlds, 1e8 steps"`). The committed table has 4 replicas of that, and
8 of each other, by `--replicas 8 --block 8 --only "PPO, as run, 1 world"` and so on. Settings are those that
recipes/study/learners/tuning_commons.py chose. DQN samples eight transitions a step, as the study's does: in
W worlds one update a turn of 8 W. PPO has minibatches of 50, 256 and 2,048 steps.

What agents become in a hundred million steps, expected before it was looked at, when the harvests of two
replicas were known: neither ruin nor restraint. The harvest falls, then rises slowly to the end. Each agent
keeps to a part of the board more than random ones do, with an exclusion below a half. A best response gains
some tens of apples, and scripted greed pays among these agents: what they spare is not defended.
"""

from typing import Any, Final

import cprl
from cprl import presets
from cprl.algorithms import DQN, PPO, DQNSettings, RolloutSettings
from cprl.population import AgentSpec, Learning

STEPS: Final = 500_000
LONG: Final = 100_000_000


def dqn(worlds: int, steps: int) -> DQN:
    """Return DQN whose exploration decays over the first half of the training."""
    settings = DQNSettings(
        gamma=0.99,
        learning_rate=1e-3,
        tau=0.005,
        buffer_size=50_000,
        epsilon_decay_steps=steps // 2,
        steps_per_update=worlds,
        batch_size=8 * worlds,
    )
    return DQN(settings=settings)


def ppo(worlds: int, epochs: int = 4) -> PPO:
    turns, minibatch = {1: (250, 50), 16: (64, 256), 256: (64, 2048)}[worlds]
    settings = RolloutSettings(
        gamma=0.99, learning_rate=1e-3, rollout_steps=turns, minibatch_size=minibatch, epochs=epochs
    )
    return PPO(settings=settings, entropy_coeff=0.05)


def agents(algorithm: DQN | PPO) -> tuple[AgentSpec, ...]:
    return (Learning(algorithm),) * 4


def conditions() -> dict[str, dict[str, Any]]:
    table: dict[str, dict[str, Any]] = {}
    for variant, called in {"as_run": "as run", "published": "published"}.items():
        game = presets.game("commons", variant=variant)
        for name in ("PPO", "DQN"):
            for worlds, steps in ((1, STEPS), (16, STEPS), (256, STEPS), (256, 2 * STEPS)):
                algorithm = ppo(worlds) if name == "PPO" else dqn(worlds, steps)
                label = f"{name}, {called}, {worlds} world{'s' * (worlds > 1)}{', as long' * (steps > STEPS)}"
                table[label] = {"game": game, "agents": agents(algorithm), "worlds": worlds, "steps": steps}
    table["PPO, as run, 256 worlds, 1e8 steps"] = {
        "agents": agents(ppo(256, epochs=1)),
        "worlds": 256,
        "steps": LONG,
    }
    return table


STUDY = cprl.Study(
    cprl.Experiment(
        name="many_worlds",
        game=presets.game("commons", variant="as_run"),
        agents=agents(ppo(1)),
        steps=STEPS,
        replicas=4,
        evaluation_episodes=20,
    ),
    conditions=conditions(),
    replicas=4,
    block=2,
    reference="PPO, as run, 1 world",
    question="What does a population learn that learns from many worlds at once?",
    expectation=(
        "With the same number of steps, more worlds mean fewer and larger updates: in 256 worlds, with 8 "
        "(PPO) or 1 (DQN) where one world has some 100 or 256, agents have learned less, so boards last "
        "longer and the harvest is nearer to that of random play; sixteen worlds are between. In the same "
        "time the difference is smaller, and has the same sign. After 1e8 steps of PPO the tragedy has not "
        "ended: independent learners find no restraint by experience alone, the harvest is below twice that "
        "of random play, and boards die before half of their turns."
    ),
)

if __name__ == "__main__":
    cprl.study_main(STUDY)
