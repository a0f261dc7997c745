"""ViewerCallback: records a training for the Rerun viewer, and shows it live."""

from collections.abc import Iterator, Mapping, Sequence
from math import ceil, gcd
from operator import methodcaller
from pathlib import Path
from threading import Event
from types import TracebackType
from typing import Any, Final, Self

from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from cprl.envs.commons_env import CommonsEnv
from cprl.envs.unwrap import action_count, agent_names, commons_of
from cprl.measuring.episodes import Episode, own_name
from cprl.measuring.evaluate import Policy
from cprl.measuring.registry import reported_by
from cprl.measuring.series import Observer
from cprl.pictures.readable import rules_of
from cprl.policies.present import PresentPolicy
from cprl.runs.episodes import stored_episodes
from cprl.runs.recipe import read_recipe, rules_of_own
from cprl.system.output import console
from cprl.system.process import at_signals
from cprl.values.arrays import Float64
from cprl.viewer.exhibition import Exhibition
from cprl.viewer.frames import Filming, Wall
from cprl.viewer.logger import RerunLogger, recording_id
from cprl.viewer.page import FILE_NAME, recordings_of
from cprl.viewer.pictures import Pictures, Samples, borders, regions_of
from cprl.viewer.scene import curves_of, missing_in, scene_of
from cprl.viewer.story import CompilingNotice, Events, Header, Story
from cprl.viewer.views import JointActions, Plots, View

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
        is_replay: whether a stored policy is replayed, see `cprl.viewer.scene.Scene`.
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
        self.env = env
        self._run = run
        reported = reported_by(env)
        commons = commons_of(env)
        curves = curves_of(env, agent_names(env), reported, episodes=episodes, worlds=worlds, own=metrics)
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
        self.filming = Filming(commons, self.logger, episodes=-(-episodes // worlds))
        """Which episodes of the first world are recorded frame by frame."""
        self._turn = self._episode = 0
        """Turns, and episodes that all replicas have ended: what header, board and timelines say."""
        self.logger.log_hparams({"run": run.name, **(recipe or {})})
        self.logger.log_text(f"{title} begins")
        for missing in missing_in(reported, has_board=scene is not None):
            self.logger.log_text(missing)
        if live and scene is None:
            self.logger.log_text("no exhibition: the game has no board")
        self.story: Story | None = None
        self.exhibition: Exhibition | None = None
        """What the current policy plays for viewers; None where nothing is exhibited."""
        every = max(1, min(LONGEST, episodes // _IMAGES))
        self._views: list[View] = [
            self.filming,
            Plots(self.logger),
            Events(self.logger, self.filming, every=ceil(every / worlds)),
        ]
        if curves.joint:
            self._views.append(JointActions(self.logger, actions=action_count(env)))
        if commons is not None:
            self._views += self._views_of_boards(commons, exhibited)
        if not is_replay:
            game = None if commons is None else commons.game
            rules = ", ".join(filter(None, (rules_of(game), rules_of_own(recipe or {}))))
            header = Header(curves=self.logger.curves, episodes=episodes, rules=rules, is_about=is_about)
            self._views += self._views_of_a_training(commons, header, every)
        self._sampled = gcd(*(view.stride for view in self._views)) or 1
        """Turns from one look at the worlds to the next where no frame is recorded."""

    @classmethod
    def of(
        cls,
        experiment: Any,
        run: Path,
        env: EnvBase,
        *,
        live: str | None = None,
        exhibited: tuple[PresentPolicy, EnvBase] | None = None,
    ) -> Self:
        """Return what shows the training of an `Experiment`, whose recipe is in the run's directory."""
        recipe = read_recipe(run)
        circumstances = {name: recipe.get(name) for name in ("command", "started", "git", "versions")}
        return cls(
            run,
            env,
            title=experiment.title,
            episodes=experiment.length.episodes,
            is_about=experiment.length.is_of_steps,
            worlds=experiment.worlds,
            metrics=[own_name(metric) for metric in experiment.metrics],
            recipe={**recipe["experiment"], **circumstances},
            live=live,
            exhibited=exhibited,
        )

    def _views_of_boards(
        self, commons: CommonsEnv, exhibited: tuple[PresentPolicy, EnvBase] | None
    ) -> Iterator[View]:
        if regions := regions_of(commons):
            self.logger.log_static("world/regions", borders(regions))
        live = self.logger.live
        if exhibited is not None and live is not None and live.exhibition is not None:
            self.exhibition = Exhibition(*exhibited, trained=self.env, logger=self.logger)
            yield self.exhibition

    def _views_of_a_training(self, commons: CommonsEnv | None, header: Header, every: int) -> Iterator[View]:
        logger = self.logger
        scene = self.logger.scene
        samples = None
        if commons is not None and scene is not None:
            if scene.boards > 1:
                recorded = header.episodes // scene.worlds // max(1, self.filming.every) + 1
                steps = commons.game.rules.episode_steps * recorded
                yield Wall(commons, logger, self.filming, scene, recorded_steps=steps)
            samples = Samples(commons, logger)
            yield samples
        yield Pictures(logger, samples, every=every)
        self.story = Story(logger, self.filming, header)
        yield self.story
        if logger.live is not None:
            yield CompilingNotice(self._show_status)

    def _show_status(self, status: str) -> None:
        if self.story is not None and self._episode == 0:
            self.story.begins(status)

    def on_start(self, training: Any) -> None:
        """Go on where a `Training` that is resumed is: views get the episodes that the run's table has, and
        viewers the recording so far."""
        if not training.steps:
            return
        worlds = self.logger.curves.worlds
        self._turn = training.steps // worlds
        again = Observer([self], self.env, worlds=worlds)
        with self.logger.silent():
            for episode in stored_episodes(self._run):
                again.on_episode(episode, {})
        for recording in self._earlier:
            self.logger.do(methodcaller("log_file_from_path", recording), live_only=True)
        self._set_time(max(0, self._episode - 1))
        for view in self._views:
            view.resumed()
        self.logger.log_text(f"resumed from step {training.steps:,}")

    def on_step(self, batch: TensorDictBase) -> None:
        """Let the views look at the worlds after the turn, if the first one's frames are recorded or one of
        them needs to.

        Otherwise it only counts: whatever runs here displaces a training's data from the fast caches.
        """
        self._turn += 1
        if not self.filming.is_on and self._turn % self._sampled:
            return
        self._set_time(self._episode)
        for view in self._views:
            view.on_step(batch)

    def _set_time(self, episode: int) -> None:
        self.logger.at(step=self._turn * self.logger.curves.worlds, episode=episode)

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        """Add an episode of a replica, and log its events."""
        self._set_time(self._episode)
        for view in self._views:
            view.on_episode(episode, learning)

    def on_numbers(self, episode: int, numbers: Mapping[str, Float64]) -> None:
        """Draw the numbers of an episode that all replicas have ended."""
        self._episode = episode + 1
        self._set_time(episode)
        for view in self._views:
            view.on_numbers(episode, numbers)
        self.logger.send_due()

    def seen_at_random(self, env: EnvBase, policy: Policy) -> Policy:
        """Return the policy of random play; viewers see its first world until the training begins."""
        return policy if self.exhibition is None else self.exhibition.seen(env, policy)

    def random_play(self, episodes: Sequence[Episode]) -> None:
        """Compare the training with these episodes of random play: in header, label, plots and an event."""
        for view in self._views:
            view.random_play(episodes)

    def finished(self, played: Mapping[str, Sequence[Episode]]) -> None:
        """Show that the run is finished, and close the file; a live view stays open until the end."""
        self.filming.close()
        for view in self._views:
            view.finished(played)
        self.logger.close_file()

    def linger(self) -> None:
        """Say where the recording stays served, exhibit the trained policy, wait for Ctrl-C (SIGINT) or
        SIGTERM, and close the recording; a second signal in the meantime changes nothing."""
        if not self.logger.is_live:
            console().print("The recording is no longer served.")
            return
        stopping = Event()
        with at_signals(lambda number: stopping.set()):
            where = self.logger.addresses["browser"]
            console().print(
                f"The recording stays served at {where} until Ctrl-C", soft_wrap=True, highlight=False
            )
            self.play_on(stopping)
            while not stopping.wait(1.0):
                pass
            self.logger.shutdown()

    def play_on(self, stop: Event) -> None:
        """Exhibit the trained policy until the event is set; return at once where nothing is exhibited."""
        if self.exhibition is not None:
            self.exhibition.play_on(stop)

    def flush(self) -> None:
        """Send all that waits, to the file and to viewers."""
        self.filming.close()
        self.logger.flush()

    def state_dict(self) -> dict[str, Any]:
        """Return what does not follow from the run's table; the recording is complete up to here."""
        self.flush()
        return {"frames": self.logger.frames}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.logger.frames = int(state["frames"])

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        for view in self._views:
            view.close()
        self.logger.shutdown()
