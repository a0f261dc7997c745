"""Preferences as values of a recipe.

In each, N is the number of agents, r_i the reward that the environment gives agent i in a turn (apples, less
fines, plus transfers), and r'_i the reward that agent i wants and learns from.
"""

from dataclasses import dataclass
from math import pi
from typing import Any, Final, Literal, TypeAlias

from cprl.checks import Check, check_fields, checked, either, instance, number, one_of

_WEIGHT: Final = number(0, 1e6)
_SHARE: Final = number(0, 1)
_ANGLE: Final = Check(number(-pi, pi).fits, "radians in -pi..pi, e.g. math.radians(45)")


@dataclass(frozen=True, kw_only=True)
class InequityAversion:
    """Dislikes having less than others, and having more.

    r'_i = r_i - alpha / (N - 1) sum_j max(e_j - e_i, 0) - beta / (N - 1) sum_j max(e_i - e_j, 0), over the
    others j, with smoothed rewards e_i = smoothing x (e_i of the turn before) + r_i, zero before an episode's
    first turn.

    Source: Hughes et al., "Inequity aversion improves cooperation in intertemporal social dilemmas" (2018),
    after Fehr and Schmidt (1999).

    Args:
        alpha: the dislike of being behind (disadvantageous inequity), 0..1e6; 5 is usual.
        beta: the dislike of being ahead (advantageous inequity), 0..1e6; 0.05 is usual.
        smoothing: the share of smoothed rewards that lasts into the next turn, 0..1; gamma x lambda of the
            source. With 0 only the rewards of the turn are compared, with 1 the returns so far.

    Raises:
        ValueError: for a number outside its range, in particular a negative dislike.
    """

    alpha: float
    beta: float
    smoothing: float

    def __post_init__(self) -> None:
        check_fields(self, {"alpha": _WEIGHT, "beta": _WEIGHT, "smoothing": _SHARE})


@dataclass(frozen=True, kw_only=True)
class SocialValueOrientation:
    """Dislikes turns in which rewards are shared in another proportion than it likes.

    r'_i = r_i - weight x |angle - theta_i|, with theta_i = atan2(mean of the others' rewards, r_i), in
    radians. The difference is the shorter way around the circle, 0..pi. In a turn in which r_i and the mean
    of the others are both 0, no angle is defined, and r'_i = r_i = 0.

    Source: McKee et al., "Social Diversity and Social Preferences in Mixed-Motive Reinforcement Learning"
    (2020), where rewards are never negative, so that the shorter way is the plain difference.

    Args:
        angle: the proportion that it likes, radians in -pi..pi: 0 is for itself alone, pi / 4 for both
            alike, pi / 2 for others alone, negative against others.
        weight: reward lost per radian, 0..1e6.

    Raises:
        ValueError: for a number outside its range, e.g. an angle in degrees.
    """

    angle: float
    weight: float

    def __post_init__(self) -> None:
        check_fields(self, {"angle": _ANGLE, "weight": _WEIGHT})


@dataclass(frozen=True)
class Exchange:
    """Gives a share of its reward away, and gets one of each other's: r'_i = (1 - share) r_i + share x mean
    of the others' rewards.

    If all agents do, with the same share, the sum of their rewards stays.

    Source: the reward transfers of Willis et al., "Resolving social dilemmas with minimal reward transfer"
    (2024), in which 1 - share is the self-interest level.

    Args:
        share: 0..1: 0 is the agent's own reward, 1 that of the others alone.

    Raises:
        ValueError: for a number outside its range.
    """

    share: float

    def __post_init__(self) -> None:
        check_fields(self, {"share": _SHARE})


Preference: TypeAlias = Literal["individual", "team"] | InequityAversion | SocialValueOrientation | Exchange
"""What an agent wants: "individual", its own reward; "team", the sum over all agents; or a comparison of its
own with those of others."""

PREFERENCE: Final = either(
    one_of("individual", "team"),
    instance(
        InequityAversion | SocialValueOrientation | Exchange,
        "InequityAversion, SocialValueOrientation, Exchange of cprl.preferences",
    ),
)


def check_preference(name: str, preference: Any, agents: int) -> None:
    """Refuses what is no preference, or none for a game of so few agents.

    Args:
        name: what it is called in messages.
        preference: a value of `Preference`.
        agents: the number of agents N of the game.

    Raises:
        ValueError: says what came and what is allowed.
    """
    checked(name, preference, PREFERENCE)
    if agents < 2 and not isinstance(preference, str):
        raise ValueError(
            f"{name} is {named(preference)}, which compares an agent with others, in a game of {agents} "
            "agent; allowed there: 'individual', 'team'"
        )


def named(preference: object) -> str:
    """A preference as messages name it: "team" in quotes, a value by its class."""
    return f'"{preference}"' if isinstance(preference, str) else type(preference).__name__
