"""What learners refuse before they allocate anything."""

from collections.abc import Sequence
from math import prod
from typing import Any, Final

import torch
from torch import nn

from cprl.checks import Check, checked, count, instance, is_count
from cprl.commons.spaces import Spaces
from cprl.networks.agent import AgentNetworks, parts_of
from cprl.preferences.values import Preference, check_preference, named
from cprl.system.memory import check_memory

_LEAST_BYTES: Final = 4096
"""Of a lane, whatever it learns by: its name, seeds and random number generators."""
_COPIES: Final = 6
"""Of a lane's weights while it trains: as made, stacked, target, gradient and two of the optimiser."""


def check_learner(
    spaces: Spaces,
    settings: object,
    kind: type[Any],
    agents: Sequence[int],
    replicas: int,
    first_replica: int,
    seed: int,
    reward_kind: Preference,
) -> None:
    """The arguments that every learner has.

    Raises:
        ValueError: for settings of another class, agents that the spaces do not have, replicas and a seed out
            of range, and what is no preference, or none for a game of one agent.
        TooLargeError: for more replicas than there is memory for, whatever they learn by.
    """
    checked("settings", settings, instance(kind, f"a {kind.__name__}"))
    checked("spaces", spaces, instance(Spaces, "a Spaces, e.g. Game.spaces"))
    check_preference("reward_kind", reward_kind, spaces.agents)
    most = spaces.agents - 1
    allowed = Check(
        lambda value: (
            isinstance(value, tuple)
            and 0 < len(value) == len(set(value))
            and all(is_count(agent, 0, most) for agent in value)
        ),
        f"one or more of the agents 0 to {most}, each once",
    )
    checked("agents", agents, allowed)
    checked("replicas", replicas, count(1, 2**20))
    checked("first_replica", first_replica, count(0))
    checked("seed", seed, count(0, 2**64 - 1))
    lanes = len(agents) * replicas
    check_memory(f"{replicas} replicas of {len(agents)} agents", lanes * _LEAST_BYTES, "fewer replicas")


def check_networks(network: nn.Module, lanes: int, device: str | torch.device) -> None:
    """Raises a TooLargeError if a device has too little memory to train a network like this for each lane."""
    size = sum(value.numel() * value.element_size() for value in network.parameters())
    check_memory(
        f"the networks of {lanes} learners, {size / 2**20:,.1f} MiB each, with targets and optimisers",
        lanes * size * _COPIES,
        "smaller networks or fewer replicas",
        device=device,
    )


def check_rollouts(
    size: tuple[int, int], shape: Sequence[int], dtype: torch.dtype, device: str | torch.device
) -> None:
    """Raises a TooLargeError if a device has too little memory for rollouts.

    Args:
        size: the number of steps T and of lanes L.
        shape: the shape of an observation.
        dtype: its dtype; updates read it as float32.
        device: the device of rollouts and updates.
    """
    check_memory(
        f"the rollouts of {size[1]} learners x {size[0]:,} steps",
        prod(size) * (2 * prod(shape) * (dtype.itemsize + 4) + 64),
        "fewer rollout_steps or fewer replicas",
        device=device,
    )


def refuse_unshared_reward(*, is_sharing: bool, reward_kind: Preference) -> None:
    """Raises a ValueError for a team that learns from replay by something else than the team reward."""
    if is_sharing and reward_kind != "team":
        raise ValueError(
            f'reward is {named(reward_kind)}; allowed for a team that learns from replay: "team"'
        )


def refuse_other_parts(network: nn.Module) -> None:
    """Raises a ValueError if the networks of an agent are not "actor" and "critic"."""
    parts = list(parts_of(network))
    if not isinstance(network, AgentNetworks) or parts[:2] != ["actor", "critic"]:
        raise ValueError(f'an agent has the networks {parts}; allowed: "actor" and "critic"')
