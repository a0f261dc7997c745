"""What do all studies of this folder share? The game, the learners, the outcome, the rules of asking.

The rules, set before any of these studies ran:

- The game is `commons` by the rules in the text of the study of 2019, four independent DQN agents that learn
  from sixteen worlds, 8 replicas (16 where a study says so). A condition differs in what its name says alone:
  exploration, updates and copies to targets count steps or updates, never episodes, which a rule prolongs.
- The primary outcome is the income of an episode, of all agents together, in 50 fresh worlds of each replica
  with weights frozen and an exploration of 0.05. Beside it stand the same at the training's own exploration
  of 0.1, and the last episodes of the training, two of each world, while agents learn.
- Replicas are the unit. Differences are paired by replica, which share their seeds; intervals are by
  Student's t at 95 %; all expectations of one study are one family, and Holm's method judges them together.
- An expectation says "more", "less" or "same" of a difference in the primary outcome. "Same" is held if both
  one-sided tests against `MARGIN` say so (D. Schuirmann, 1987); that 0 is in an interval says nothing. It
  failed if the difference is beyond the margin: its p in the family is twice the smallest of the three
  one-sided ones, within the margin, above and below it. What Holm's method leaves open cannot be told.
- Every share is of the most that the condition's own board and agents allow, and of the best known there.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

import cprl
from cprl import presets
from cprl.algorithms import DQN, DQNSettings
from cprl.commons.game import Game
from cprl.measuring.registry import APPLES, unit
from cprl.population import Frozen, Learning
from cprl.studies import Study
from cprl.studies.trials import trials_of

sys.path.append(str(Path(__file__).parents[1]))  # for modules of recipes/study, where this one comes first

RESULTS: Final = Path("docs", "results", "studies")
"""The directory of the results of all studies, from the root of the repository."""
WORLDS: Final = 16
STEPS: Final = 400_000
"""Steps of each replica: 25,000 turns, with an update of each agent after each but the first."""
GAME: Final = presets.game("commons")
SETTINGS: Final[DQNSettings] = replace(
    presets.dqn_settings("commons"),
    learning_rate=1e-3,
    gamma=0.97,
    batch_size=64,
    steps_per_update=WORLDS,
    epsilon_decay_steps=100_000,
    target_every_updates=250,
)
"""The published settings but for a schedule that is ten times shorter, and targets copied by updates."""
AGENT: Final = Learning(DQN(settings=SETTINGS))
EXPERIMENT: Final = cprl.Experiment(
    name="governs",
    game=GAME,
    agents=(AGENT,) * 4,
    steps=STEPS,
    replicas=8,
    worlds=WORLDS,
    evaluation_episodes=50,
)
MARGIN: Final = 50.0
"""Apples an episode that matter: a fifth of what agents get that act at random."""

Sign = Literal["more", "less", "same"]


@dataclass(frozen=True, kw_only=True)
class Expectation:
    """What is expected of a difference between conditions: the mean of some minus that of others."""

    label: str
    more: Sequence[str]
    """The conditions whose mean counts positively; "STUDY/CONDITION" is one of another study."""
    less: Sequence[str]
    sign: Sign
    why: str
    metric: str = "income"
    part: Literal["evaluation", "training"] = "evaluation"
    """Frozen in fresh worlds, or the last episodes of the training, in which agents learn."""
    margin: float = MARGIN

    def __post_init__(self) -> None:
        if self.sign == "same" and self.margin == MARGIN and unit(self.metric) != APPLES:
            raise ValueError(f"margin is {MARGIN} apples; allowed for {self.metric}: another one")


def trained(study: Study, condition: str) -> tuple[Frozen, ...]:
    """Return the agents of a condition that was trained before, in the default directory of its study."""
    runs = Path("studies", study.name, "runs")
    (run,) = (trial.directory for trial in trials_of(study, runs) if trial.condition.name == condition)
    game = next(each.experiment.game for each in study.all_conditions if each.name == condition)
    return tuple(Frozen(str(run), agent, replica=None) for agent in range(game.agents))


def game_with(base: Game = GAME, **rules: Any) -> Game:
    """Return a game with other rules."""
    return replace(base, rules=replace(base.rules, **rules))


def expected_text(expectations: Sequence[Expectation]) -> str:
    """Return expectations as the sentences that a study stores and quotes."""
    lines = [f"{one.label}: {one.sign} ({one.why})" for one in expectations]
    return "; ".join(lines) + "."
