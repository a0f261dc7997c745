"""ViewerCallback: records a training for the Rerun viewer, and shows it live on request."""

from collections.abc import Iterator, Mapping, Sequence
from math import ceil, gcd
from operator import methodcaller
from pathlib import Path
from threading import Event
from typing import Any, Final, Self

from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from cprl.commons.game import Game
from cprl.commons.maps import Map
from cprl.envs.commons_env import CommonsEnv
from cprl.envs.unwrap import action_count, agent_names, commons_of
from cprl.measuring.playing import Policy
from cprl.measuring.registry import reported_by
from cprl.measuring.series import Observer
from cprl.measuring.tracker import Episode, custom_metric_name
from cprl.pictures.image import regions_of
from cprl.pictures.readable import rules_of
from cprl.runs.episodes import stored_episodes
from cprl.runs.recipe import custom_rules_in, read_recipe
from cprl.system.output import console
from cprl.system.process import on_signals
from cprl.values import instantiate
from cprl.viewer.frames import FrameSchedule, Wall
from cprl.viewer.header import CompilingNotice, Events, Header, HeaderView
from cprl.viewer.logger import RerunLogger, recording_id
from cprl.viewer.page import RECORDING_FILE, recording_file, recordings_of
from cprl.viewer.pictures import Pictures, Samples, borders
from cprl.viewer.scene import Scene, missing_in, plotted_numbers, scene_of
from cprl.viewer.view import Exhibit, JointActions, Numbers, Plots, View

_MOST_EPISODES_BETWEEN: Final = 50
"""The largest number of episodes between two pictures of visits, stock and Lorenz curve."""
_PICTURES_OF_A_SHORT_RUN: Final = 20
"""About how many times these pictures are drawn in a run that is too short for that distance."""


class ViewerCallback:
    """Records the metrics of every episode, and the frames of the first world in some episodes.

    It is a callback of `cprl.training` and a context manager. It passes each call to its views, each of which
    records one part of the training, such as the plots or the header.

    A view is left out if the game does not report what it needs: a game without a board has no frames. Events
    at the start of the recording name the views that are left out. The windows show the observations of the
    `CommonsEnv` itself, before transforms.

    Frames are recorded for every k-th episode of the first world, including the first and the last, and for
    the episode after each new best. With several replicas, metrics are logged when all replicas have ended an
    episode: the mean and each replica; of returns, losses and the like only the mean. With W worlds per
    replica, a logged metric is the mean of W episodes. Header, board and timelines count the episodes that
    all replicas have ended.

    When a run is resumed, the views get the episodes of its table, and viewers get the recording so far.

    Args:
        run: the run's directory, to which the recording is written. If it has a recording already, the new
            file is `run-2.rrd` and so on; the viewer shows them as one recording.
        env: the worlds of all replicas, with or without transforms; the first world is shown.
        title: the name of the recording.
        episodes: the number of episodes of each replica.
        is_about: whether `episodes` is an estimate, because the training counts steps.
        worlds: the number of worlds W of each replica.
        metrics: the names of the user's metrics.
        recipe: the recipe of the run, which the recording shows as a table.
        live: "serve" or "spawn", see `cprl.viewer.live`; None writes the file only.
        exhibit: makes the view that plays the current policy for live viewers, see
            `cprl.experimental.exhibition`; None for no such view.
        replay: the name of a new recording beside those of the training, of an episode in which a stored
            policy plays, see `Scene.is_replay`; None for a training.
        earlier: the boards of the games that the training plays before that of `env`.
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
        exhibit: Exhibit | None = None,
        replay: str | None = None,
        earlier: Sequence[Map] = (),
    ) -> None:
        self.env = env
        self._run = run
        reported = reported_by(env)
        commons = commons_of(env)
        curves = plotted_numbers(
            env, agent_names(env), reported, episodes=episodes, worlds=worlds, user_metrics=metrics
        )
        scene: Scene | None = None
        if commons is not None:
            size = (
                max((board.height for board in earlier), default=0),
                max((board.width for board in earlier), default=0),
            )
            scene = scene_of(commons, curves, is_replay=replay is not None, size=size)
        self._earlier = [] if replay else recordings_of(run)
        self.logger = RerunLogger(
            title,
            run,
            curves=scene or curves,
            live=live,
            exhibits=exhibit is not None and scene is not None,
            file_name=replay or recording_file(len(self._earlier) + 1),
            recording_id=recording_id(run, replay or RECORDING_FILE),
        )
        self.schedule = FrameSchedule(commons, self.logger, episodes=-(-episodes // worlds))
        self._turn = 0
        self._episode = 0
        """The number of episodes that all replicas have ended."""
        recipe = recipe or {}
        self._custom_rules = custom_rules_in(recipe)
        self.logger.log_hparams({"run": run.name, **recipe})
        events = [f"{title} begins", *missing_in(reported, has_board=scene is not None)]
        if live and scene is None:
            events.append("no exhibition: the game has no board")
        for event in events:
            self.logger.log_text(event)
        self.header_view: HeaderView | None = None
        self.exhibition: Any = None
        """The view that plays the current policy for live viewers; None if nothing is exhibited."""
        picture_period = max(1, min(_MOST_EPISODES_BETWEEN, episodes // _PICTURES_OF_A_SHORT_RUN))
        self._views: list[View] = [
            self.schedule,
            Plots(self.logger),
            Events(self.logger, self.schedule, every=ceil(picture_period / worlds)),
        ]
        if curves.joint:
            self._views.append(JointActions(self.logger, actions=action_count(env)))
        if commons is not None:
            regions = regions_of(commons.game)
            if regions and not earlier:
                self.logger.log_static("world/regions", borders(regions))
        served = self.logger.live
        if exhibit is not None and served is not None and served.exhibition is not None:
            self.exhibition = exhibit(env, self.logger)
            self._views.append(self.exhibition)
        if replay is None:
            header = Header(
                curves=self.logger.curves, episodes=episodes, rules=self._rules(commons), is_about=is_about
            )
            self._views += self._training_views(commons, header, picture_period)
        self._step_stride = gcd(*(view.stride for view in self._views)) or 1
        """Turns between two calls of the views' `on_step` in episodes without frames."""

    @classmethod
    def of(
        cls,
        experiment: Any,
        run: Path,
        env: EnvBase,
        *,
        live: str | None = None,
        exhibit: Exhibit | None = None,
    ) -> Self:
        """Return the callback that records the training of an `Experiment`.

        Args:
            run: the run's directory, which holds the recipe already.
        """
        recipe = read_recipe(run)
        games = [instantiate(part.game) for part in experiment.earlier]
        start_conditions = {name: recipe.get(name) for name in ("command", "started", "git", "versions")}
        return cls(
            run,
            env,
            title=experiment.title,
            episodes=experiment.length.episodes,
            is_about=experiment.length.is_of_steps,
            worlds=experiment.worlds,
            metrics=[custom_metric_name(metric) for metric in experiment.metrics],
            recipe={**recipe["experiment"], **start_conditions},
            live=live,
            exhibit=exhibit,
            earlier=[game.map for game in games if isinstance(game, Game)],
        )

    def _rules(self, commons: CommonsEnv | None) -> str:
        """Return the institutions and custom rules of the game in words."""
        game = None if commons is None else commons.game
        return ", ".join(filter(None, (rules_of(game), self._custom_rules)))

    def _training_views(
        self, commons: CommonsEnv | None, header: Header, picture_period: int
    ) -> Iterator[View]:
        """Yield the views that a training has and a replay lacks."""
        logger = self.logger
        scene = logger.scene
        samples = None
        if commons is not None and scene is not None:
            if scene.boards > 1:
                recorded_episodes = header.episodes // scene.worlds // max(1, self.schedule.every) + 1
                recorded_steps = commons.game.rules.episode_steps * recorded_episodes
                yield Wall(commons, logger, self.schedule, recorded_steps=recorded_steps)
            samples = Samples(commons, logger)
            yield samples
        yield Pictures(logger, samples, every=picture_period)
        self.header_view = HeaderView(logger, self.schedule, header)
        yield self.header_view
        if logger.live is not None:
            yield CompilingNotice(self.header_view.begins)

    def on_start(self, training: Any) -> None:
        """Continue the recording if the `Training` is resumed.

        The views get the episodes of the run's table, and viewers get the recording so far.
        """
        if training.env is not self.env:
            self._show(training.env)
        if not training.steps:
            return
        worlds = self.logger.curves.worlds
        self._turn = training.steps // worlds
        repeating = Observer([self], self.env, worlds=worlds)
        with self.logger.silent():
            for episode in stored_episodes(self._run):
                repeating.on_episode(episode, {})
        for recording in self._earlier:
            self.logger.call_on_recordings(methodcaller("log_file_from_path", recording), live_only=True)
        self._set_time(max(0, self._episode - 1))
        for view in self._views:
            view.resumed()
        self.logger.log_text(f"resumed from step {training.steps:,}")

    def on_game(self, env: EnvBase, changes: str) -> None:
        """Show the worlds of the next game, and an event that says what differs."""
        self._set_time(self._episode)
        self.logger.log_text(f"from step {self.logger.step:,} on: {changes}")
        self._show(env)

    def _show(self, env: EnvBase) -> None:
        """Show these worlds from now on."""
        self.env = env
        commons = commons_of(env)
        scene = self.logger.scene
        if self.header_view is not None:
            self.header_view.change_rules(self._rules(commons))
        if commons is None or scene is None:
            return
        self.logger.log_row("world/regions", borders(regions_of(commons.game)))
        scene = scene_of(commons, scene, size=(scene.height, scene.width))
        self.logger.curves = scene
        for view in self._views:
            view.on_board(commons, scene)

    def on_step(self, batch: TensorDictBase) -> None:
        """Pass a turn to the views, if its frame is recorded or a view needs it.

        Other turns are only counted: any work here would displace the training's data from the CPU caches.
        """
        self._turn += 1
        if not self.schedule.is_on and self._turn % self._step_stride:
            return
        self._set_time(self._episode)
        for view in self._views:
            view.on_step(batch)

    def _set_time(self, episode: int) -> None:
        self.logger.set_time(step=self._turn * self.logger.curves.worlds, episode=episode)

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        """Pass an episode of one world to the views."""
        self._set_time(self._episode)
        for view in self._views:
            view.on_episode(episode)

    def on_numbers(self, episode: int, numbers: Numbers) -> None:
        """Log the numbers of an episode that all replicas have ended."""
        self._episode = episode + 1
        self._set_time(episode)
        for view in self._views:
            view.on_numbers(episode, numbers)
        self.logger.send_due()

    def seen_at_random(self, env: EnvBase, policy: Policy) -> Policy:
        """Return the policy of random play; live viewers see its first world until the training begins."""
        if self.exhibition is None:
            return policy
        watched: Policy = self.exhibition.watch_random_play(env, policy)
        return watched

    def random_play(self, episodes: Sequence[Episode]) -> None:
        """Compare the training with these episodes of random play in header, label, plots and an event."""
        for view in self._views:
            view.random_play(episodes)

    def finished(self, played: Mapping[str, Sequence[Episode]]) -> None:
        """Show that the run is finished, and close the file; the live recording stays open."""
        self.schedule.close()
        for view in self._views:
            view.finished(played)
        self.logger.close_file()

    def linger(self) -> None:
        """Keep the recording served and exhibit the trained policy until Ctrl-C (SIGINT) or SIGTERM.

        Further signals have no effect while the recording is closed.
        """
        if not self.logger.is_live:
            console().print("The recording is no longer served.")
            return
        stopping = Event()
        with on_signals(lambda number: stopping.set()):
            address = self.logger.addresses["browser"]
            console().print(
                f"The recording stays served at {address} until Ctrl-C", soft_wrap=True, highlight=False
            )
            self.play_on(stopping)
            while not stopping.wait(1.0):
                pass
            self.logger.shutdown()

    def play_on(self, stop: Event) -> None:
        """Exhibit the trained policy until the event is set; return at once if nothing is exhibited."""
        if self.exhibition is not None:
            self.exhibition.play_on(stop)

    def flush(self) -> None:
        """Send all recorded frames and numbers, to the file and to viewers."""
        self.schedule.close()
        self.logger.flush()

    def state_dict(self) -> dict[str, Any]:
        """Complete the recording up to now; return the number of its frames, which the run's table lacks."""
        self.flush()
        return {"frames": self.logger.frames}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.logger.frames = int(state["frames"])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        for view in self._views:
            view.close()
        self.logger.shutdown()
