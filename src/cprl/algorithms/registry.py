"""Algorithms as plain tables, as a run's recipe keeps them, and back."""

from collections.abc import Iterable, Mapping
from dataclasses import fields
from typing import Any, Final, TypeAlias

from cprl.algorithms.actor_critic import IQL, SAC
from cprl.algorithms.dqn import CQL, DQN, DistributionalDQN, OffPolicy
from cprl.algorithms.on_policy import A2C, PPO, OnPolicy, Reinforce
from cprl.algorithms.on_policy_teams import IPPO, MAPPO
from cprl.algorithms.tabular import Tabular
from cprl.algorithms.teams import QMIX, VDN, TeamAlgorithm
from cprl.learners.settings import DQNSettings, RolloutSettings, TabularSettings

Algorithm: TypeAlias = OffPolicy | OnPolicy | TeamAlgorithm | Tabular
"""What an agent that learns is made of."""

OF_CPRL: Final[tuple[type[Any], ...]] = (
    *(DQN, DistributionalDQN, CQL, SAC, IQL),
    *(PPO, A2C, Reinforce),
    *(VDN, QMIX, MAPPO, IPPO),
    Tabular,
)
_SETTINGS: Final[dict[str, type[Any]]] = {
    kind.__name__: kind for kind in (DQNSettings, RolloutSettings, TabularSettings)
}


def told(algorithm: Algorithm) -> dict[str, Any]:
    """Its name and fields; those of its settings by the name of their class.

    Raises:
        ValueError: where it is no dataclass, so that it could not be built again.
    """
    try:
        own = {field.name: getattr(algorithm, field.name) for field in fields(algorithm)}  # type: ignore[arg-type]
    except TypeError as error:
        kind = type(algorithm).__name__
        raise ValueError(f"{kind} is no dataclass; as one a run's recipe can keep what it was") from error
    settings = own.pop("settings")
    return {
        "algorithm": type(algorithm).__name__,
        **own,
        "settings": {
            "kind": type(settings).__name__,
            **{field.name: getattr(settings, field.name) for field in fields(settings)},
        },
    }


def built(table: Mapping[str, Any], *, own: Iterable[type[Any]] = ()) -> Algorithm:
    """The algorithm that `told` told.

    Args:
        table: as it was told.
        own: algorithms of the user's own that it may be.

    Raises:
        ValueError: for an algorithm or settings that are not known, or other fields than theirs.
    """
    kinds = {kind.__name__: kind for kind in (*OF_CPRL, *own)}
    rest = dict(table)
    name, settings = rest.pop("algorithm"), dict(rest.pop("settings"))
    kind_of_settings = settings.pop("kind")
    if name not in kinds:
        raise ValueError(f"{name} is an algorithm of somebody's own; give it as one of `algorithms`")
    if kind_of_settings not in _SETTINGS:
        raise ValueError(f"settings are of the kind {kind_of_settings}; known are {', '.join(_SETTINGS)}")
    tuples = {key: tuple(value) if isinstance(value, list) else value for key, value in settings.items()}
    try:
        algorithm: Algorithm = kinds[name](settings=_SETTINGS[kind_of_settings](**tuples), **rest)
    except TypeError as error:
        raise ValueError(f"{name} has other fields: {error}") from error
    return algorithm
