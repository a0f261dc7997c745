"""tracker_of: an `EpisodeTracker` that knows what the environment's game has."""

from torchrl.envs import EnvBase

from cprl.envs.unwrap import agent_count
from cprl.measuring.episodes import EpisodeTracker
from cprl.measuring.institutional import institutions_of
from cprl.measuring.yields import yield_of


def tracker_of(env: EnvBase, max_steps: int | None = None) -> EpisodeTracker:
    """An `EpisodeTracker` for all worlds of an environment, with its institutions and what its board bears.

    Args:
        env: worlds of a game, transforms or not.
        max_steps: see `EpisodeTracker`.
    """
    return EpisodeTracker(
        env.batch_size.numel(),
        agent_count(env),
        max_steps,
        institutions=institutions_of(env),
        **yield_of(env),
    )
