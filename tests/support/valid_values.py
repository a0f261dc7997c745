"""A valid value of each kind that a recipe holds."""

from dataclasses import MISSING, fields, replace
from functools import cache
from typing import get_type_hints

from tiny_study import GAME, LEARNING, TINY

import cprl
from cprl import algorithms, institutions, population
from cprl.objectives import rewards
from cprl.policies.governors import Constant
from cprl.values import KINDS

REQUIRED = {
    "Game": lambda: replace(GAME, institutions=(institutions.Quota(fine=1.0), institutions.Monitoring())),
    "Map": lambda: GAME.map,
    "EarlierGame": lambda: cprl.EarlierGame(game=GAME, steps=100),
    "Learning": lambda: LEARNING,
    "Team": lambda: population.Team(algorithms.VDN(settings=algorithms.DQNSettings()), agents=(0, 1)),
    "Language": lambda: population.Language(model="small"),
    "Frozen": lambda: population.Frozen("runs/none", agent=0),
    "OwnPast": lambda: population.OwnPast(agent=0),
    "Pool": lambda: population.Pool(runs=(population.Frozen("runs/none", agent=0),)),
    "RandomEnd": lambda: cprl.RandomEnd(prob=0.15),
    "InequityAversion": lambda: rewards.InequityAversion(alpha=5, beta=0.05, smoothing=0.9),
    "SocialValueOrientation": lambda: rewards.SocialValueOrientation(angle=0.5, weight=1.0),
    "Exchange": lambda: rewards.Exchange(0.5),
    "Boundaries": lambda: institutions.Boundaries.strips(height=3, width=5, agents=2),
    "Levies": lambda: institutions.Levies(groups=((0,), (1,))),
    "Vote": lambda: institutions.Vote(on=institutions.Tax()),
    "Constant": lambda: Constant(0.5),
    "Governor": lambda: institutions.Governor(sets="tax.rate"),
    "Custom": lambda: cprl.Custom("torchrl.envs.transforms:RewardScaling", arguments={"loc": 0.0}),
}
"""Values of the kinds that cannot be made of nothing, or of their settings alone."""


@cache
def valid(name):
    """A valid value of a registered kind, or an experiment."""
    if name == "Experiment":
        return TINY
    kind = KINDS[name]
    if name in REQUIRED:
        return REQUIRED[name]()
    required = [field.name for field in fields(kind) if field.init and field.default is MISSING]
    return kind(settings=get_type_hints(kind)["settings"]()) if "settings" in required else kind()


EVERY = [valid(name) for name in sorted({*KINDS, "Experiment"})]
