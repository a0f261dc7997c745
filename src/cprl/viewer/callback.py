"""ViewerCallback: records a training for the Rerun viewer, and shows it live."""

import time
from collections.abc import Iterator, Mapping, Sequence
from math import ceil, gcd
from operator import methodcaller
from pathlib import Path
from threading import Event
from types import TracebackType
from typing import Any, Final, Self

import numpy as np
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from cprl.envs.unwrap import agent_names, base_env, commons_of
from cprl.measuring.episodes import Episode
from cprl.measuring.evaluate import Policy
from cprl.measuring.registry import IN_FORCE, reported_by
from cprl.measuring.series import OF_AGENTS, Series, numbers_of
from cprl.measuring.table import metrics_in
from cprl.policies.present import PresentPolicy
from cprl.runs.episodes import read_episodes
from cprl.runs.recipe import rules_of_own
from cprl.viewer.board import Filming
from cprl.viewer.exhibition import Exhibition
from cprl.viewer.layout import curves_of, missing_in, scene_of
from cprl.viewer.logger import RerunLogger, recording_id
from cprl.viewer.page import FILE_NAME, recordings_of
from cprl.viewer.pictures import (
    JointActions,
    Lorenz,
    Plots,
    Tags,
    Turns,
    View,
    Visits,
    Wall,
    borders,
    regions_of,
)
from cprl.viewer.story import CompilingNotice, Events, Story

LONGEST: Final = 50
"""Episodes from one image of visits, stock and Lorenz curve to the next, at most."""
_IMAGES: Final = 20
"""The images of a short run, about."""


class ViewerCallback:
    """Logs the metrics of every episode, and the frames of the first world in some episodes.

    Views that need what the game does not report are left out: a game without a board has no frames; for
    metrics see `cprl.measuring.registry`. One event of the recording names them. With transforms, windows
    show the observations of the `CommonsEnv` itself.

    Frames are recorded for every k-th episode of that world, including the first and the last, and for the
    episode after each new best. With several replicas metrics are logged once all have ended an episode: the
    mean and each replica; returns, losses and the like as means only. With W worlds a replica, metrics are
    means over every W episodes. Header, board and timelines count the episodes that all replicas have ended.
    A callback of `cprl.training`, and a context manager.

    Of a run that is resumed the views get the episodes in its table, and viewers the recording so far.

    Args:
        run: the run's directory, where the recording is written. If there is one already, the new file is
            `run-2.rrd` and so on; the viewer shows them as one recording.
        env: the worlds of all replicas, with transforms or without; the first is shown.
        episodes: of each replica.
        is_about: whether it is only about as many, because so many steps are trained.
        worlds: the worlds W of each replica.
        metrics: the names of the user's own.
        live: "serve" or "spawn", see `cprl.viewer.live`; None for the file alone.
        exhibited: what is exhibited live: the current policy and one world for it, see
            `cprl.viewer.exhibition`.
        file_name: the name of the recording instead of `run.rrd`; there must be no such file.
        is_replay: whether a stored policy is replayed, see `cprl.viewer.layout.Scene`.
    """

    is_extendable = True

    def __init__(
        self,
        run: Path,
        env: EnvBase,
        *,
        title: str,
        episodes: int,
        is_about: bool = False,
        worlds: int = 1,
        metrics: Sequence[str] = (),
        recipe: Mapping[str, object] | None = None,
        live: str | None = None,
        exhibited: tuple[PresentPolicy, EnvBase] | None = None,
        file_name: str | None = None,
        is_replay: bool = False,
    ) -> None:
        self.env, self._run, self._agents = env, run, agent_names(env)
        reported, commons = reported_by(env), commons_of(env)
        curves = curves_of(env, self._agents, reported, episodes=episodes, worlds=worlds, own=metrics)
        scene = None if commons is None else scene_of(commons, curves, is_replay=is_replay)
        self._earlier = [] if file_name else recordings_of(run)
        self.logger = RerunLogger(
            title,
            run,
            curves=scene or curves,
            live=live,
            exhibits=exhibited is not None and scene is not None,
            file_name=file_name or (f"run-{len(self._earlier) + 1}.rrd" if self._earlier else FILE_NAME),
            recording_id=recording_id(run, file_name or FILE_NAME),
        )
        self.filming = Filming(commons, self.logger, scene, episodes=-(-episodes // worlds))
        """Which episodes of the first world are recorded frame by frame."""
        self._series = Series(curves.replicas, worlds)
        self._turn = self._step = self._filmed = 0
        self._episode = 0
        """The episodes that all replicas have ended: what header, board and timelines say."""
        self._rate_at, self._rate_step = time.perf_counter(), 0
        self.logger.log_hparams({"run": run.name, **(recipe or {})})
        self.logger.log_text(f"{title} begins")
        for missing in missing_in(reported, has_board=scene is not None):
            self.logger.log_text(missing)
        if live and scene is None:
            self.logger.log_text("no exhibition: the game has no board")
        self.story: Story | None = None
        self.exhibition: Exhibition | None = None
        """What the current policy plays for viewers; None where nothing is exhibited."""
        own_rules = rules_of_own(recipe or {})
        self._views = self._make_views(episodes, exhibited, own_rules, is_about=is_about, is_replay=is_replay)
        self._sampled = gcd(*(view.stride for view in self._views)) or 1
        """Turns from one look at the worlds to the next where no frame is recorded."""
        self.filming.choose(0)

    def _make_views(
        self,
        episodes: int,
        exhibited: tuple[PresentPolicy, EnvBase] | None,
        own_rules: str,
        *,
        is_about: bool,
        is_replay: bool,
    ) -> list[View]:
        logger, commons = self.logger, commons_of(self.env)
        curves, scene, live = logger.curves, logger.scene, logger.live
        every = max(1, min(LONGEST, episodes // _IMAGES))
        of_world = ceil(every / curves.worlds)
        views: list[View] = [Plots(logger), Events(logger, self.filming, every=of_world)]
        if curves.joint:
            views.append(JointActions(logger, actions=base_env(self.env).game.actions))
        if curves.has_tags_between:
            views.append(Tags(logger))
        if commons is not None and scene is not None:
            if regions := regions_of(commons):
                logger.log_static("world/regions", borders(regions))
            if exhibited is not None and live is not None and live.exhibition is not None:
                self.exhibition = Exhibition(
                    *exhibited, trained=self.env, scene=scene, kept=live.stream, newest=live.exhibition
                )
                views.append(self.exhibition)
        if is_replay:
            return views
        if commons is not None and scene is not None:
            if scene.boards > 1:
                recorded = episodes // scene.worlds // max(1, self.filming.every) + 1
                steps = commons.game.rules.episode_steps * recorded
                views.append(Wall(commons, logger, scene, recorded_steps=steps))
            views += [Visits(commons, logger, scene, every=every), Turns(commons, logger, every=every)]
        if curves.has_lorenz:
            views.append(Lorenz(logger, every=every))
        game = None if commons is None else commons.game
        self.story = Story(
            logger, self.filming, episodes=episodes, is_about=is_about, game=game, own_rules=own_rules
        )
        views.append(self.story)
        if live is not None:
            views.append(CompilingNotice(self._show_status))
        return views

    def _show_status(self, status: str) -> None:
        if self.story is not None and self._episode == 0:
            self.story.begins(status)

    def on_start(self, training: Any) -> None:
        """Goes on where a `Training` that is resumed is."""
        if training.steps:
            self._resume(training.steps)

    def _resume(self, step: int) -> None:
        """Gives the views the episodes that the run's table has, and viewers the recording so far."""
        self._step = self._rate_step = step
        self._turn = step // self._series.worlds
        with self.logger.silent():
            for episode in _stored_episodes(self._run):
                self.on_episode(episode, {})
        for view in self._views:
            view.resumed()
        for recording in self._earlier:
            self.logger.do(methodcaller("log_file_from_path", recording), live_only=True)
        self.logger.at(step=step, episode=self._episode)
        if self.story is not None:
            self.story.resume()
        self.logger.log_text(f"resumed from step {step:,}")

    def on_step(self, batch: TensorDictBase) -> None:
        """Copies the state of the first world after the turn, if this episode's frames are recorded.

        Otherwise it only counts: reading a tensor each turn would cost a training some percent.
        """
        self._turn += 1
        self._step += self._series.worlds
        if not self.filming.is_on and self._turn % self._sampled:
            return  # nothing is due; whatever runs here displaces a training's data from the fast caches
        self.filming.choose(self._filmed)
        frame = self.filming.add(batch, step=self._step, episode=self._episode)
        for view in self._views:
            view.on_step(self._turn, self._episode, frame)
            view.on_batch(batch)

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        """Logs the numbers of an episode, and its events, once all replicas have ended it."""
        self.logger.at(step=self._step, episode=self._episode)
        for view in self._views:
            view.on_episode(episode)
        if episode.world == 0:
            self._filmed, self.filming.shows_next = self._filmed + 1, False
        of_all = self._series.add(episode, numbers_of(episode, learning, self._agents))
        if of_all is not None:
            self._episode += self._series.worlds
            self.logger.at(step=self._step, episode=self._episode - 1)
            with self.logger.together():
                for view in self._views:
                    view.on_all(self._episode - 1, of_all)
                self._log_speed()
        self.filming.choose(self._filmed)

    def _log_speed(self) -> None:
        now, steps = time.perf_counter(), (self._step - self._rate_step) * self._series.replicas
        if steps:
            self.logger.log_scalar("time/env_steps_per_s", steps / (now - self._rate_at))
            self._rate_at, self._rate_step = now, self._step

    def seen_at_random(self, env: EnvBase, policy: Policy) -> Policy:
        """Return the policy of random play; viewers see its first world until the training begins."""
        return policy if self.exhibition is None else self.exhibition.seen(env, policy)

    def random_play(self, episodes: Sequence[Episode]) -> None:
        """Compares the training with these episodes of random play: in header, label, plots and an event."""
        for view in self._views:
            view.random_play(episodes)

    def finished(self, played: Mapping[str, Sequence[Episode]]) -> None:
        """Shows that the run is finished, and closes the file; a live view stays open until the end."""
        self.filming.send()
        for view in self._views:
            view.finished(played)
        self.logger.close_file()

    def play_on(self, stop: Event) -> None:
        """Exhibits the trained policy until the event is set; returns at once where nothing is exhibited."""
        if self.exhibition is not None:
            self.exhibition.play_on(stop)

    def flush(self) -> None:
        """Sends all that waits, to the file and to viewers."""
        self.filming.send()
        self.logger.flush()

    def state_dict(self) -> dict[str, Any]:
        """What does not follow from the run's table; the recording is complete up to here."""
        self.flush()
        return {"frames": self.logger.frames}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.logger.frames = int(state["frames"])

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.filming.send()
        for view in self._views:
            view.close()
        self.logger.shutdown()


def _stored_episodes(run: Path) -> Iterator[Episode]:
    """The episodes of a run's table in the order in which they ended, without who tagged whom; none without a
    table."""
    try:
        table = read_episodes(run).combine_chunks()
    except FileNotFoundError:
        return
    if not table.num_rows:
        return
    columns = {name: table[name].to_numpy(zero_copy_only=False) for name in table.column_names}
    agents = int(columns["agent"].max()) + 1
    metrics = [name for name in metrics_in(table.schema) if name != "stock_left"]
    in_force = [name for name in columns if name.startswith(IN_FORCE)]
    for row in range(0, table.num_rows, agents):
        replica, number = int(columns["replica"][row]), int(columns["episode"][row])

        def of_agents(name: str, row: int = row) -> Any:
            return columns[name][row : row + agents].astype(np.float64) if name in columns else None

        def of_all(name: str, row: int = row) -> Any:
            return int(columns[name][row]) if name in columns else None

        yield Episode(
            world=int(columns["world"][row]) if "world" in columns else replica,
            replica=replica,
            episode=number,
            steps=int(columns["steps"][row]),
            terminated=bool(columns["terminated"][row]),
            return_=of_agents("return"),
            metrics={name: float(columns[name][row]) for name in metrics},
            harvest=of_agents("harvest"),
            stock_left=of_all("stock_left"),
            depletion_step=of_all("depletion_step"),
            in_force=np.array([columns[name][row] for name in in_force]) if in_force else None,
            **{name: of_agents(name) for name in OF_AGENTS},
        )
