"""Replay: a stored policy plays again, and every step is recorded."""

from collections.abc import Mapping
from pathlib import Path

import torch
from tensordict import TensorDictBase
from torch import nn

from cprl import keys
from cprl.envs.commons_env import CommonsEnv
from cprl.measuring.episodes import Episode
from cprl.policies.assignment import AgentIndices
from cprl.stored import load
from cprl.training import Callback, train
from cprl.viewer.callback import ViewerCallback

SEED = 20_011
"""Of the fresh worlds; no training of ours uses it."""


def replay(run: Path, out: Path | None = None, *, replica: int = 0, episode: int = 0) -> tuple[Path, Episode]:
    """Lets the agents of a run play an episode in a fresh world, with `epsilon_evaluation`.

    Args:
        run: its directory, or its results.
        out: the recording to be; by default `replay-<replica>-<episode>.rrd` in the run's directory.
        replica: whose agents.
        episode: which of the fresh episodes; the same number plays the same again.

    Returns:
        The recording, and how the episode went.

    Raises:
        ValueError: for a run that cannot be loaded; see `cprl.load`.
        FileExistsError: where the recording is there already.
    """
    if episode < 0:
        raise ValueError(f"episode is {episode}; at least 0 is wanted")
    loaded = load(run)
    target = out or run / f"replay-{replica}-{episode}.rrd"
    env = CommonsEnv(loaded.game, 1, seed=SEED, first_world=episode)
    torch.manual_seed(SEED + episode)  # TorchRL's exploration draws from torch's generator
    actors: dict[AgentIndices, nn.Module] = dict(enumerate(loaded.policy(replica).actors))
    title = f"{run.name}, agents of replica {replica}, fresh episode {episode}"
    target.parent.mkdir(parents=True, exist_ok=True)
    with ViewerCallback(
        target.parent,
        env,
        title=title,
        episodes=1,
        recipe=loaded.recipe,
        file_name=target.name,
        is_replay=True,
    ) as watch:
        teller = _Teller(watch)
        callbacks: list[Callback] = [watch, teller]
        train(env, {}, others=actors, episodes=1, callbacks=callbacks)
    assert teller.episode is not None
    return target, teller.episode


class _Teller:
    """Tells every tag and how the episode ended, and keeps the episode."""

    def __init__(self, watch: ViewerCallback) -> None:
        self.watch = watch
        self.episode: Episode | None = None
        self._step = 0

    def on_step(self, batch: TensorDictBase) -> None:
        """Tells who was tagged by whom."""
        self._step += 1
        for tagged, by in batch["next"][keys.TAGGED_BY][0].nonzero().tolist():
            self._tell(f"agent {tagged} is tagged out by agent {by}")

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        """Tells how it went."""
        self.episode = episode
        apples = ", ".join(f"{own:.0f}" for own in episode.harvest)
        self._tell(f"the end after {episode.steps} steps; apples: {apples}; {episode.stock_left} left")

    def _tell(self, event: str) -> None:
        self.watch.logger.at(step=self._step, episode=0)
        self.watch.log_event(event)
