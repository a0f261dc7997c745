"""HostedRound: the worlds of all groups of people under one treatment, turn by turn, and what is kept of
them.

Each turn is appended to a journal before anybody sees it, so that a process that is killed loses no finished
turn. The actions are all that a restart needs: the worlds, the other agents and all chance follow from the
seed, and `HostedRound.begin` plays them again.
"""

from base64 import b64encode
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import torch
from pyarrow.csv import write_csv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from cprl import keys
from cprl.commons.game import Game
from cprl.envs.commons_env import CommonsEnv
from cprl.evaluation.fresh import averages_of
from cprl.experiment import Experiment
from cprl.measuring.registry import COLLECTIVE_RETURN
from cprl.measuring.statistics import estimate_if_finite
from cprl.measuring.tracker import Episode, tracker_of
from cprl.pictures.decoding import classes_seen, window_text
from cprl.pictures.readable import instructions_of, options_of
from cprl.population import AgentSpec, Person, has_people, partners_in
from cprl.runs.episodes import stored_episodes
from cprl.runs.files import REPORT, write_atomically
from cprl.runs.journal import Journal, batches_in, read_journal
from cprl.runs.played import write_played
from cprl.runs.states import start
from cprl.training.agents import Population
from cprl.training.stored import LoadedRun
from cprl.values.array_types import Bool, Int64
from cprl.web.hosting import TRAINED
from cprl.web.scenes import moment_json, scene_json, window_colours
from cprl.web.session import HostedSession

NONE: Final = -1
"""What stands for no action, or no vote: a script, or chance, decides."""
_COLUMNS: Final = {
    "turn": pa.int32(),
    "ms": pa.int64(),
    "group": pa.int16(),
    "agent": pa.int16(),
    "person": pa.bool_(),
    "given": pa.bool_(),
    "action": pa.int16(),
    "cell": pa.int32(),
    "heading": pa.int8(),
    "in_play": pa.bool_(),
    "harvest": pa.float32(),
    "reward": pa.float32(),
    "fired": pa.bool_(),
    "tagged": pa.bool_(),
    "stock": pa.int32(),
    "decision": pa.int32(),
    "rule": pa.int16(),
    keys.VIOLATED[-1]: pa.bool_(),
    keys.FINES[-1]: pa.float32(),
}
TURN_COLUMNS: Final = pa.schema(_COLUMNS)
"""The columns of turns.parquet, a row for each turn, group and agent; docs/people.md describes them.

"ms" counts since 1970; "person": a person acts, also by doing nothing, and no script for who has left;
"given": the person chose the action; "cell", "heading" and "in_play" are those after the turn; "decision" is
-1 without ballots; "rule" is the option that a governor has put in force, -1 where none decides."""
CHAT_COLUMNS: Final = pa.schema(
    {**{name: _COLUMNS[name] for name in ("turn", "ms", "group", "agent")}, "text": pa.string()}
)
"""The columns of chat.parquet; "turn" is the one that was played last."""
_COLUMNS_OF: Final = {"turns": TURN_COLUMNS, "chat": CHAT_COLUMNS}
"""The columns of each file that is kept of a round, by its name."""


class HostedRound:
    """A round of a session, or a practice round. Making it checks and warms up all that it needs.

    Args:
        session: the session.
        number: the index of its treatment.
        name: the name of the treatment.
        game: its game, see `HostedSession.games`.
        runs: the runs whose agents may play as "trained".
        folder: the run's directory, which `begin` makes; None for a practice round.

    Raises:
        ValueError: if no run has agents that can play the game.
    """

    def __init__(
        self,
        session: HostedSession,
        number: int,
        name: str,
        game: Game,
        *,
        runs: Sequence[LoadedRun],
        folder: Path | None,
    ) -> None:
        self.session = session
        self.number = number
        self.name = name
        self.game = game
        self.folder = folder
        self.seed = session.seed + number
        self._runs = runs
        self._governor = session.governor_of(game, runs)
        self._journals: dict[str, Journal] = {}
        self.episodes: dict[int, Episode] = {}
        """The episode of each group that has ended."""
        self._find_agents()
        self.play(self.nothing(), self.nothing())
        self.views()
        self._set_up()
        if self.is_finished and folder is not None:
            self.episodes = {episode.replica: episode for episode in stored_episodes(folder)}

    def _find_agents(self) -> None:
        """Find agents that can play, those of a run where some are to be trained."""
        runs: Sequence[LoadedRun | None] = self._runs if TRAINED in self.session.agents else [None]
        refused: ValueError | None = None
        for run in runs:
            self._specs = self.session.specs(run)
            try:
                self._set_up()
                return
            except ValueError as error:
                refused = error
        raise ValueError(f"round {self.name!r}: {refused}") from refused

    def _set_up(self) -> None:
        """Put worlds, agents and totals at their beginning."""
        self._env = CommonsEnv(self.game, self.session.groups, seed=self.seed)
        population = Population(self._env, self._specs, seed=self.seed, governor=self._governor)
        self._policy = population.policy(1)
        self._tracker = tracker_of(self._env)
        self._moment = self._env.reset()
        self._income = np.zeros((self.session.groups, self.game.agents))
        self._violated = np.zeros(self._income.shape, np.bool_)
        self.turn = 0
        self.episodes.clear()

    @property
    def is_over(self) -> bool:
        """Return whether the episode of each group has ended."""
        return len(self.episodes) == self.session.groups

    @property
    def is_finished(self) -> bool:
        """Return whether the run is written."""
        return self.folder is not None and (self.folder / REPORT).exists()

    @property
    def has_chat(self) -> bool:
        """Return whether people may write to their group."""
        return self.session.chat or self.game.rules.signals > 0

    def begin(self, session_id: str) -> None:
        """Make the run's directory, or play the turns again that an earlier process has kept.

        Args:
            session_id: what all rounds of the session have in common, see `cprl.runs.states.start`.

        Raises:
            ValueError: if the turns are not those that were kept.
        """
        if self.folder is None:
            return
        if not self.folder.exists():
            people: list[AgentSpec] = [Person()] * self.session.people
            experiment = Experiment(
                name=f"round-{self.number + 1}",
                game=self.game,
                agents=(*people, *self._specs[self.session.people :]),
                episodes=1,
                replicas=self.session.groups,
                seed=self.seed,
                governor=self._governor,
            )
            start(self.folder, experiment, partners_in(experiment.specs), session=session_id)
        self._journals = {name: Journal(self.folder / f"{name}.arrows") for name in _COLUMNS_OF}
        for batch, _ in batches_in(self._journals["turns"].path):
            self._play_again(batch)

    def _play_again(self, batch: pa.RecordBatch) -> None:
        agents = batch["group"].to_numpy(), batch["agent"].to_numpy()
        action = self.nothing()
        action[agents] = batch["action"]
        decision = self.nothing()
        decision[agents] = batch["decision"]
        self.play(action, decision)
        if not np.array_equal(self._cells()[agents], batch["cell"]):
            raise ValueError(
                f"{self.folder} cannot be continued: turn {self.turn}, played again, is another one; "
                "was it begun with another version of cprl?"
            )

    def nothing(self) -> Int64:
        """Return actions, or decisions, of G groups of N agents of which none is given: int64 [G, N],
        NONE."""
        return np.full((self.session.groups, self.game.agents), NONE)

    def play(self, action: Int64, decision: Int64) -> None:
        """Play a turn of all groups.

        Args:
            action: int64 [G, N], the actions that are given; scripts and trained agents take the others.
            decision: int64 [G, N], decisions that are given, see `Game.decisions`; the others fall by chance.
        """
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            acted = self._policy(self._moment)
            for key, given in ((keys.ACTION, action), (keys.DECISION, decision)):
                if key in acted.keys(True):
                    np.copyto(acted[key].numpy(), given, where=given != NONE)
            self._batch, self._moment = self._env.lean_step(acted, resets=False)
        self.turn += 1
        self._income += self._batch["next", keys.AGENTS, "reward"][..., 0].numpy()
        if self.game.institutions:
            self._violated = self._batch["next", keys.VIOLATED].numpy()
        for episode in self._tracker.add(self._batch):
            self.episodes.setdefault(episode.world, episode)

    def keep(self, groups: Sequence[int], person: Bool, given: Bool, ms: int) -> None:
        """Append the turn of some groups to the journal.

        Args:
            groups: those whose episodes had not ended before the turn.
            person: bool [G, N], whether a person acts, see `TURN_COLUMNS`.
            given: bool [G, N], whether the person chose the action.
            ms: the time, milliseconds since 1970.
        """
        if self.folder is None:
            return
        agents = self._batch["next", keys.AGENTS]
        now = self._env.worlds.now
        values = {
            "turn": self.turn,
            "ms": ms,
            "group": np.arange(self.session.groups)[:, None],
            "agent": np.arange(self.game.agents),
            "person": person,
            "given": given,
            "action": self._batch[keys.ACTION].numpy(),
            "cell": self._cells(),
            "heading": now.heading,
            "reward": agents["reward"][..., 0].numpy(),
            "tagged": agents["tagged_by"].numpy().any(-1),
            "stock": now.stock_left,
            "decision": self._batch[keys.DECISION].numpy() if self.game.decisions else NONE,
            "rule": NONE if self._governor is None else self._batch[keys.RULE].numpy()[:, None],
            keys.VIOLATED[-1]: self._violated,
        }
        for _, name in (keys.IN_PLAY, keys.HARVEST, keys.FIRED, keys.FINES):
            values[name] = agents.get(name, torch.zeros(())).numpy()
        rows = {name: np.broadcast_to(array, person.shape)[groups].ravel() for name, array in values.items()}
        self._journals["turns"].add(pa.record_batch(rows, TURN_COLUMNS))

    def _cells(self) -> Int64:
        now = self._env.worlds.now
        cells: Int64 = now.row * self.game.map.width + now.col
        return cells

    def keep_chat(self, group: int, agent: int, text: str, ms: int) -> None:
        """Append a line of chat to the journal."""
        if self.folder is not None:
            row = {"turn": self.turn, "ms": ms, "group": group, "agent": agent, "text": text}
            self._journals["chat"].add(pa.RecordBatch.from_pylist([row], CHAT_COLUMNS))

    def finish(self) -> None:
        """Write the run: its episodes, turns.parquet, turns.csv and chat.parquet."""
        if self.folder is None:
            return
        tables = {
            name: read_journal(journal.path, _COLUMNS_OF[name]) for name, journal in self._journals.items()
        }
        write_atomically(self.folder / "turns.csv", partial(write_csv, tables["turns"]))
        write_played(self.folder, [*self.episodes.values()], **tables)
        self.close()
        for journal in self._journals.values():
            journal.path.unlink()

    def close(self) -> None:
        """Close the journals, which a later process can continue."""
        for journal in self._journals.values():
            journal.close()

    # what people see

    def fixed(self) -> dict[str, Any]:
        """Return the parts of the message "round" that all people share."""
        game = self.game
        return {
            "rule": self.name,
            "instructions": instructions_of(game, self.session.view),
            "view": self.session.view,
            "turns_a_second": self.session.turns_a_second or None,
            "episode_steps": game.rules.episode_steps,
            "actions": game.actions,
            "options": options_of(game),
            "chat": self.has_chat,
            "observation_shape": game.observation_shape,
            "window_colours": window_colours(game),
            **scene_json(game),
        }

    def views(self) -> list[dict[str, Any]]:
        """Return the parts of the message "turn" that the people of each group share."""
        views = []
        for group in range(self.session.groups):
            world = self._env.worlds.show(self._env.output, world=group)
            views.append(
                {
                    "turn": self.turn,
                    "harvest": world.harvested.tolist(),
                    "income": self._income[group].round(2).tolist() if self.game.institutions else None,
                    "stock": int(world.stock.sum()),
                    "rule_in_force": "; ".join(self.in_force(group)) or None,
                    "board": moment_json(self.game.map, world, self._violated[group]),
                }
            )
        return views

    def in_force(self, group: int) -> list[str]:
        """Return the title and the value of all that is in force by decision, after the first turn."""
        decided = self.game.in_force
        values = self._moment[keys.IN_FORCE][group].tolist() if decided and self.turn else []
        return [f"{ballot.title}: {value:g}" for ballot, value in zip(decided, values, strict=False)]

    def in_play(self) -> Bool:
        """Return which agents can act in the coming turn, bool [G, N]."""
        in_play: Bool = self._moment[keys.IN_PLAY].numpy().copy()
        in_play[[*self.episodes]] = False
        return in_play

    def narrowed(self, view: dict[str, Any], group: int, agent: int, form: str) -> dict[str, Any]:
        """Return a group's part of "turn" for who sees no board.

        Args:
            view: that of `views`; numbers that the game does not show its agents become None.
            form: the form of what the agent observes, see `seen`.
        """
        narrowed = {**view, **self.seen(group, agent, form)}
        del narrowed["board"]
        if not self.game.observation.stock_gauge:
            narrowed["stock"] = None
        for name in ("harvest", "income"):
            if view[name] and not self.game.observation.scoreboard:
                narrowed[name] = [None] * self.game.agents
                narrowed[name][agent] = view[name][agent]
        return narrowed

    def seen(self, group: int, agent: int, view: str) -> dict[str, str]:
        """Return what an agent observes, in the form that its seat asks for: "window", "array" or "text"."""
        observation = self._moment[keys.OBSERVATION].numpy()[group, agent]
        if view == "array":
            return {"observation": b64encode(observation.tobytes()).decode()}
        if view == "text":
            return {"text": window_text(self.game, observation)}
        classes = classes_seen(self.game, observation[None, None])[0, 0]
        return {"window": b64encode(classes.tobytes()).decode()}

    def result(self, group: int) -> dict[str, Any]:
        """Return how the round ended for a group, as messages say it."""
        episode = self.episodes[group]
        assert episode.harvest is not None
        return {
            "harvest": episode.harvest.astype(int).tolist(),
            "income": episode.return_.round(2).tolist() if self.game.institutions else None,
            "survival_steps": episode.steps,
            "ended": "no apple was left" if episode.terminated else "time was up",
        }

    def trained(self) -> dict[str, Any] | None:
        """Return the harvest of an agent, and the turns, of trained agents that played this very game.

        They are means over replicas; of several replicas also their intervals. None without such agents.
        """
        runs = [run for run in self._runs if run.game == self.game and not has_people(run.specs)]
        averages = averages_of(runs[0]) if runs else {}
        if not averages:
            return None
        turns, apples = np.transpose([*averages.values()])
        trained: dict[str, Any] = {}
        for name, values in (("harvest", apples / self.game.agents), ("survival_steps", turns)):
            mean = estimate_if_finite(values.tolist()).bounded(COLLECTIVE_RETURN)
            trained[name] = mean.value
            trained[f"{name}_interval"] = mean.interval if len(values) > 1 else None
        return trained
