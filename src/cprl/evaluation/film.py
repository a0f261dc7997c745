"""film: records an episode of the agents of a stored run, step by step."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from cprl import arguments, keys
from cprl.arguments import FILM_SEED as SEED
from cprl.envs.unwrap import commons_of
from cprl.measuring.episodes import Episode
from cprl.policies.assignment import AgentPolicies
from cprl.runs.files import refuse_to_write_over
from cprl.stored import LoadedRun, load
from cprl.training import train
from cprl.viewer.callback import ViewerCallback
from cprl.viewer.decisions import Decisions
from cprl.viewer.institutions import has_institutions
from cprl.viewer.offences import Offences, events


@dataclass(frozen=True, kw_only=True, eq=False)
class FreshEpisode:
    """A fresh world of a run's game, and who plays in it."""

    run: LoadedRun
    env: EnvBase = field(repr=False)
    """One world, with the run's transforms."""
    policies: AgentPolicies = field(repr=False)


def fresh_episode(
    run: str | Path, *, replica: int = 0, episode: int = 0, seed: int = SEED, allow: Sequence[str] = ()
) -> FreshEpisode:
    """The world and the agents of an episode that is filmed; equal numbers give equal episodes. See `film`.

    Raises:
        ValueError: if the run cannot be loaded, see `cprl.load`, or a number is out of range.
    """
    episode = arguments.integer("episode", episode, 0, 2**32 - 1)
    replica = arguments.integer("replica", replica, 0)
    seed = arguments.seed(seed)
    arguments.object_of("run", run, (str, Path), "a directory")
    loaded = load(run, allow=allow)
    if replica not in loaded.replicas:
        replicas = ", ".join(map(str, loaded.replicas))
        raise ValueError(f"replica is {replica}; allowed: {replicas}, those of {run}")
    return FreshEpisode(
        run=loaded,
        env=loaded.env(1, seed=seed, first_world=episode),
        policies=loaded.policy(replica, seed=seed + episode),
    )


def film(
    run: str | Path,
    out: str | Path | None = None,
    *,
    replica: int = 0,
    episode: int = 0,
    seed: int = SEED,
    allow: Sequence[str] = (),
) -> tuple[Path, Episode]:
    """Records an episode of a run's agents in a fresh world, with the exploration of evaluation.

    Args:
        run: its directory, or its exported results.
        out: the recording, a .rrd, complete or absent; by default `film-<replica>-<episode>.rrd` in the run's
            directory.
        replica: the index of the agents' replica.
        episode: the index of the fresh episode; equal indices give equal episodes.
        seed: of the worlds and all chance. The world is that of `evaluate_run` with the same seed, of number
            replica x episodes + episode there; what agents draw is their own.
        allow: see `cprl.load`.

    Returns:
        The recording, and the episode.

    Raises:
        ValueError: if the run cannot be loaded, see `cprl.load`, a number is out of range, or the suffix is
            another.
        FileExistsError: if the recording exists.
    """
    arguments.object_of("out", out, (str, Path, type(None)), "a path, or None")
    if out is not None and Path(out).suffix != ".rrd":
        raise arguments.refusal("out", str(out), "a .rrd; film_video makes a .gif or an .mp4")
    fresh = fresh_episode(run, replica=replica, episode=episode, seed=seed, allow=allow)
    target = Path(run) / f"film-{replica}-{episode}.rrd" if out is None else Path(out)
    refuse_to_write_over(target)
    target.parent.mkdir(parents=True, exist_ok=True)
    title = f"{Path(run).name}, agents of replica {replica}, fresh episode {episode}"
    try:
        return target, _recorded(fresh, target, title)
    except BaseException:  # a recording of half an episode would stand in the way of the next attempt
        target.unlink(missing_ok=True)
        raise


def _recorded(fresh: FreshEpisode, target: Path, title: str) -> Episode:
    """Plays the episode into a recording."""
    others = dict(zip(fresh.policies.indices, fresh.policies.actors, strict=True))
    with ViewerCallback(
        target.parent,
        fresh.env,
        title=title,
        episodes=1,
        recipe=fresh.run.recipe,
        file_name=target.name,
        is_replay=True,
    ) as viewer:
        events = _Events(viewer)
        train(
            fresh.env,
            {},
            others=others,
            decisions=fresh.policies.decisions,
            episodes=1,
            callbacks=[viewer, *_decisions(viewer, fresh), *_offences(viewer, fresh), events],
        )
    assert events.episode is not None
    return events.episode


def _decisions(viewer: ViewerCallback, fresh: FreshEpisode) -> list[Decisions]:
    """What agents choose by, of games whose boards are shown."""
    scene, game = viewer.logger.scene, fresh.run.game
    if scene is None:
        return []
    shown = Decisions(
        viewer.logger, fresh.policies, actions=game.actions, names=scene.agents, window=scene.window
    )
    return [shown]


def _offences(viewer: ViewerCallback, fresh: FreshEpisode) -> list[Offences]:
    """Who breaks rules and what is paid, of games with institutions whose boards are shown."""
    scene, commons = viewer.logger.scene, commons_of(fresh.env)
    if scene is None or commons is None or not has_institutions(scene):
        return []
    return [Offences(viewer.logger, commons, names=scene.agents)]


class _Events:
    """Logs every tag, violation and the outcome of the episode, and stores the episode."""

    def __init__(self, viewer: ViewerCallback) -> None:
        self.viewer = viewer
        self.episode: Episode | None = None
        self._step = 0

    def on_step(self, batch: TensorDictBase) -> None:
        """Logs who was tagged by whom, and who broke a rule."""
        self._step += 1
        tagged_by = batch.get(("next", *keys.TAGGED_BY), None)
        if tagged_by is not None:
            for tagged, by in tagged_by[0].nonzero().tolist():
                self._log(f"agent {tagged} is tagged out by agent {by}")
        for event in events(batch):
            self._log(event)

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        """Logs the outcome."""
        self.episode = episode
        self._log(f"the end; {episode.outcome}")

    def _log(self, event: str) -> None:
        self.viewer.logger.at(step=self._step, episode=0)
        self.viewer.log_event(f"step {self._step:,}: {event}")
