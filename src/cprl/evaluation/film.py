"""film: records an episode of the agents of a stored run, step by step."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from tensordict import TensorDictBase

from cprl import arguments, keys
from cprl.measuring.episodes import Episode
from cprl.stored import load
from cprl.training import train
from cprl.viewer.callback import ViewerCallback

SEED = 20_011
"""The seed of fresh worlds; no training of ours uses it."""


def film(
    run: str | Path,
    out: str | Path | None = None,
    *,
    replica: int = 0,
    episode: int = 0,
    allow: Sequence[str] = (),
) -> tuple[Path, Episode]:
    """Records an episode of a run's agents in a fresh world, with the exploration of evaluation.

    Args:
        run: its directory, or its exported results.
        out: the recording; by default `film-<replica>-<episode>.rrd` in the run's directory.
        replica: the index of the agents' replica.
        episode: the index of the fresh episode; equal indices give equal episodes.
        allow: see `cprl.load`.

    Returns:
        The recording, and the episode.

    Raises:
        ValueError: if the run cannot be loaded, see `cprl.load`, or a number is out of range.
        FileExistsError: if the recording exists.
    """
    episode = arguments.integer("episode", episode, 0, 2**32 - 1)
    replica = arguments.integer("replica", replica, 0)
    arguments.object_of("run", run, (str, Path), "a directory")
    arguments.object_of("out", out, (str, Path, type(None)), "a path, or None")
    loaded = load(run, allow=allow)
    if replica not in loaded.replicas:
        raise ValueError(f"replica is {replica}; allowed: {', '.join(map(str, loaded.replicas))}")
    target = Path(run) / f"film-{replica}-{episode}.rrd" if out is None else Path(out)
    env = loaded.env(1, seed=SEED, first_world=episode)
    policies = loaded.policy(replica, seed=SEED + episode)
    others = dict(zip(policies.indices, policies.actors, strict=True))
    title = f"{Path(run).name}, agents of replica {replica}, fresh episode {episode}"
    target.parent.mkdir(parents=True, exist_ok=True)
    with ViewerCallback(
        target.parent,
        env,
        title=title,
        episodes=1,
        recipe=loaded.recipe,
        file_name=target.name,
        is_replay=True,
    ) as viewer:
        events = _Events(viewer)
        train(env, {}, others=others, episodes=1, callbacks=[viewer, events])
    assert events.episode is not None
    return target, events.episode


class _Events:
    """Logs every tag and the outcome of the episode, and stores the episode."""

    def __init__(self, viewer: ViewerCallback) -> None:
        self.viewer = viewer
        self.episode: Episode | None = None
        self._step = 0

    def on_step(self, batch: TensorDictBase) -> None:
        """Logs who was tagged by whom."""
        self._step += 1
        tagged_by = batch.get(("next", *keys.TAGGED_BY), None)
        if tagged_by is not None:
            for tagged, by in tagged_by[0].nonzero().tolist():
                self._log(f"agent {tagged} is tagged out by agent {by}")

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        """Logs the outcome."""
        self.episode = episode
        self._log(f"the end; {episode.outcome}")

    def _log(self, event: str) -> None:
        self.viewer.logger.at(step=self._step, episode=0)
        self.viewer.log_event(f"step {self._step:,}: {event}")
