"""The tragedy of the commons under rules that people make: Ostrom's eight principles, one at a time.

    python recipes/institutions.py --institution quota         16 replicas of 200 episodes

Four independent DQN agents on `commons`, in one world of each replica, on a schedule twenty times shorter
than the published one, under one institution or under none. docs/institutions.md compares them.
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

SHORT = {"learning_rate": 1e-4, "epsilon_decay_steps": 100_000, "gamma": 0.95}
"""The differences from the published schedule, as in recipes/study/base.py."""

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

SHARE = 0.25
WINDOW = 50
"""The share and the window of every quota here: a quarter of the map's proven yield, counted in windows of 50
turns: 6.9 apples per agent and window, of which an agent may take 6."""

INSTITUTIONS: dict[Choice, tuple[Institution, ...]] = {
    "none": (),
    "boundaries": (Boundaries.strips(height=12, width=24, agents=4),),
    "quota": (Quota(share=SHARE, window_steps=WINDOW),),
    "vote": (Vote(on=Tax(), choices=(0.0, 0.25, 0.5, 0.75)),),
    "monitoring": (Quota(share=SHARE, window_steps=WINDOW, fine=2.0), Monitoring(prob=0.5)),
    "graduated_sanctions": (
        Quota(share=SHARE, window_steps=WINDOW, fine=0.0),
        GraduatedSanctions(freeze_steps=(5, 25, 100, 100), fines=(0, 1, 2, 4), recovery_steps=50),
    ),
    "mediation": (Quota(share=SHARE, window_steps=WINDOW, fine=0.0), Mediation(turns=WINDOW, refund=1.0)),
    "sanctioner": (Sanctioner(),),
    "levies": (Levies(groups=((0, 1), (2, 3)), local_rate=0.3, joint_rate=0.2),),
}
"""One sensible setting for each of Ostrom's principles."""


def experiment(*, institution: Choice = "none") -> cprl.Experiment:
    """Train four independent DQN agents on `commons` under an institution.

    Args:
        institution: which one, by its name.
    """
    game = presets.game("commons", variant="as_run")
    apart = any(isinstance(rule, Mediation) for rule in INSTITUTIONS[institution])
    settings = replace(presets.dqn_settings("commons", variant="as_run"), **SHORT)
    return cprl.Experiment(
        name=f"institutions_{institution}",
        game=replace(
            game,
            observation=replace(game.observation, agents_apart=apart),
            institutions=INSTITUTIONS[institution],
        ),
        agents=(Learning(DQN(settings=settings)),) * 4,
        episodes=200,
        replicas=16,
        evaluation_episodes=50,
    )


if __name__ == "__main__":
    cprl.recipe_main(experiment)
