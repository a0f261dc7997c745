"""The tragedy of the commons under rules that people make: Ostrom's eight principles, one at a time.

    python recipes/institutions.py --institution quota         8 replicas of 16 worlds, 400,000 steps

Four independent DQN agents on `commons`, by the published rules, under one institution or under none, on the
schedule of recipes/tragedy.py. docs/institutions.md compares them.
Copy this file and change it: another institution, or several together, is one line.
"""

from dataclasses import replace
from typing import Literal

import cprl
from cprl import presets
from cprl.algorithms import DQN
from cprl.institutions import (
    Boundaries,
    GraduatedSanctions,
    Institution,
    Levies,
    Mediation,
    Monitoring,
    Quota,
    Sanctioner,
    Tax,
    Vote,
)
from cprl.population import Learning

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

Choice = Literal[
    "none",
    "boundaries",
    "quota",
    "vote",
    "monitoring",
    "graduated_sanctions",
    "mediation",
    "sanctioner",
    "levies",
]

QUOTA = Quota(share=0.25, window_steps=50)
"""A quarter of the map's proven yield: 6.9 apples per agent in 50 turns, of which an agent may take 6."""

INSTITUTIONS: dict[Choice, tuple[Institution, ...]] = {
    "none": (),
    "boundaries": (Boundaries.strips(height=12, width=24, agents=4),),
    "quota": (QUOTA,),
    "vote": (Vote(on=Tax(), choices=(0.0, 0.25, 0.5, 0.75)),),
    "monitoring": (replace(QUOTA, fine=2.0), Monitoring(prob=0.5)),
    "graduated_sanctions": (
        replace(QUOTA, fine=0.0),
        GraduatedSanctions(freeze_steps=(5, 25, 100, 100), fines=(0, 1, 2, 4), recovery_steps=50),
    ),
    "mediation": (replace(QUOTA, fine=0.0), Mediation(turns=50, refund=1.0)),
    "sanctioner": (Sanctioner(),),
    "levies": (Levies(groups=((0, 1), (2, 3)), local_rate=0.3, joint_rate=0.2),),
}
"""One sensible setting for each of Ostrom's principles."""


def experiment(*, institution: Choice = "none") -> cprl.Experiment:
    """Train four independent DQN agents on `commons` under an institution.

    Args:
        institution: which one, by its name.
    """
    game = presets.game("commons")
    apart = any(isinstance(rule, Mediation) for rule in INSTITUTIONS[institution])
    return cprl.Experiment(
        name=f"institutions_{institution}",
        game=replace(
            game,
            observation=replace(game.observation, agents_apart=apart),
            institutions=INSTITUTIONS[institution],
        ),
        agents=(Learning(DQN(settings=SETTINGS)),) * 4,
        steps=400_000,
        replicas=8,
        worlds=WORLDS,
        evaluation_episodes=50,
    )


if __name__ == "__main__":
    cprl.recipe_main(experiment)
