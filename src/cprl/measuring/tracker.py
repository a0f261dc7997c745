"""Episode, the record of a finished episode, and EpisodeTracker, which makes episodes of batches of turns."""

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from math import isfinite, nan
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from cprl import keys
from cprl.commons.game import Game
from cprl.envs.unwrap import agent_count, commons_game_of
from cprl.institutions import COUNT_NAMES
from cprl.keys import Turn
from cprl.measuring.registry import (
    AGENT_TOTALS,
    ENTRY_KEYS,
    IN_FORCE_PREFIX,
    METRICS,
    TOTALS,
    compute_metrics,
    constants_of,
    counts_for,
    reported_in,
)
from cprl.values import Custom, Positive, checked, metric_words
from cprl.values.array_types import AnyArray, Float64, Int64

TurnArrays = dict[str, AnyArray]
"""The entries of one turn or several, [B, ...] or [B, T, ...], by the last part of their keys."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Episode:
    """One episode of one world, from its first step to its end. Steps are counted from 1; arrays are
    read-only."""

    world: int
    """The index of the world in its batch."""
    episode: int
    """The index of the episode in its world, or in a training in its replica, counted from 0."""
    steps: int
    """Steps played, at least 1."""
    replica: int = -1
    """The replica that played it in a training; outside of a training by default the world."""
    terminated: bool
    """True if the game itself ended, e.g. no apple was left and none could grow; else the episode was
    truncated at its time limit."""
    return_: Float64
    """[N], the undiscounted sum of rewards of each agent."""
    metrics: Mapping[str, float]
    """Metrics by the names of `cprl.measuring.registry.METRICS`, then decisions, as
    "institutions/in_force_0", and custom metrics; NaN if undefined. Metrics whose entries the game does not
    report are missing."""
    harvest: Float64 | None = None
    """[N], apples harvested. This field and all below are None if the game does not report the entries that
    they need, see `cprl.measuring.registry.ENTRIES_OF_FIELDS`."""
    in_play_steps: Int64 | None = None
    """[N], steps in which the agent was in play."""
    shots: Int64 | None = None
    """[N], beams fired."""
    hits: Int64 | None = None
    """[N], the number of agents hit by each agent's beams, summed over steps."""
    tagged: Int64 | None = None
    """[N], how often each agent was tagged out; two hits in one step count once."""
    tagged_by: Int64 | None = None
    """[N, N], how often the agent of the row was tagged by the agent of the column."""
    wanted_return: Float64 | None = None
    """[N], the shaped return of each agent in a training, see `cprl.objectives.rewards`; NaN for agents that
    do not learn. None outside of a training."""
    stock_left: int | None = None
    """Apples on the board at the end."""
    depletion_step: int | None = None
    """The first step that left no apple on the board, or -1."""
    fines: Float64 | None = None
    """[N], what institutions took from each agent, taxes included, in units of reward. This field and all
    below are None for games without institutions."""
    transfers: Float64 | None = None
    """[N], what institutions gave each agent."""
    violations: Int64 | None = None
    """[N], steps in which the agent broke a rule of an institution."""
    counts: Mapping[str, Int64] | None = None
    """[N] by name, the counts of the game's institutions, see `cprl.measuring.registry.counts_for`."""
    decision: Int64 | None = None
    """[N], the decision of each agent, see `cprl.Game.ballots`; None in games without ballots."""
    in_force: Float64 | None = None
    """[V], the decisions in force in this episode: tax rates, quotas, the agent elected."""

    def __post_init__(self) -> None:
        if self.replica < 0:
            object.__setattr__(self, "replica", self.world)
        for name, value in list(vars(self).items()):
            if isinstance(value, np.ndarray):
                object.__setattr__(self, name, _read_only(value))

    def __repr__(self) -> str:
        returns = [round(value, 2) for value in self.return_.tolist()]
        ended = f"{self.steps} steps, terminated={self.terminated}"
        return f"Episode(world={self.world}, episode={self.episode}, {ended}, returns={returns})"

    @property
    def outcome(self) -> str:
        """Return the outcome as text: apples if the game reports a harvest, else returns."""
        if self.harvest is None:
            return f"returns: {', '.join(f'{value:.4g}' for value in self.return_)}"
        left = "" if self.stock_left is None else f"; {self.stock_left} left"
        return f"apples: {', '.join(f'{apples:.0f}' for apples in self.harvest)}{left}"

    @property
    def reported(self) -> tuple[str, ...]:
        """Return the optional entries that the game reported, see `cprl.measuring.registry`."""
        totals = [name for name, value in vars(self).items() if value is not None and name in TOTALS]
        entries = {TOTALS[name].entry for name in totals}
        return tuple(entry for entry in ENTRY_KEYS if entry in entries)


def _read_only(array: AnyArray) -> AnyArray:
    """Return a read-only view of an array."""
    view = array.view()
    view.flags.writeable = False
    return view


_TAKEN_NAMES: Final = {
    *(entry.name for entry in fields(Episode)),
    *METRICS,
    *TOTALS,
    "role",
    "composition",
    "restrained_agents",
    "window_episodes",
    "agent",
    "policy",
    "trained_episodes",
    "focal",
    "focal_agent",
    "focal_agents",
    "background",
    "scenario",
    "restrained",
    "runs",
    "worlds",
    "response",
    "chosen",
}
"""Names that custom metrics may not have: those of columns of tables, labels and other metrics."""


def custom_metric_name(metric: Custom) -> str:
    """Return the name of a custom metric, which is that of its function."""
    return re.split("[:.]", metric.target)[-1]


def check_custom_metrics(metrics: Sequence[Custom]) -> None:
    """Refuse custom metrics with the name of another number of an episode.

    Raises:
        ValueError: for a name that is taken or that no column can have; the message names the metric.
    """
    names = [custom_metric_name(metric) for metric in metrics]
    for name, metric in zip(names, metrics, strict=True):
        if not name.isidentifier():
            raise ValueError(f"{metric.target}: a metric is called as its function; allowed: one with a name")
        if name in _TAKEN_NAMES or name.startswith(("return_", "in_force_")) or names.count(name) > 1:
            raise ValueError(f"{metric.target}: another number of an episode is called {name}; rename it")


def custom_metrics(metrics: Sequence[Custom], episode: Episode) -> dict[str, float]:
    """Return the custom metrics of an episode by name; NaN for one that is NaN or infinite.

    Raises:
        ValueError: if one fails or returns no number; the message names it.
    """
    if not metrics:
        return {}
    counts = episode.counts
    read_only = replace(
        episode,
        metrics=MappingProxyType(episode.metrics),
        counts=counts and MappingProxyType({name: _read_only(array) for name, array in counts.items()}),
    )
    values = {}
    for metric in metrics:
        try:
            with np.errstate(divide="ignore", invalid="ignore"):  # 0 / 0: undefined
                value = metric.make(read_only)
                number = float(value)
        except Exception as error:
            raise ValueError(
                f"the metric {metric.target} gives no number of {episode!r}: {error!r}"
            ) from error
        values[custom_metric_name(metric)] = number if isfinite(number) else nan
    return values


def try_custom_metrics(metrics: Sequence[Custom], env: EnvBase) -> dict[str, dict[str, str]]:
    """Refuse custom metrics that fail on an episode of one turn in which all entries are 0, or all are 1.

    Returns:
        The "title" and "unit" of those whose functions have such attributes, by their names.
    """
    for entry in (0, 1) if metrics else ():
        example_episode(env, metrics, entry=entry)
    words = {custom_metric_name(metric): metric_words(metric) for metric in metrics}
    return {name: word for name, word in words.items() if word}


def example_episode(env: EnvBase, metrics: Sequence[Custom] = (), *, entry: int = 0) -> Episode:
    """Return an episode of one turn in which all entries of an environment are the same number."""
    batch = env.fake_tensordict().apply(partial(torch.full_like, fill_value=entry))
    batch["done"].zero_()
    batch["next", "done"].fill_(True)
    return tracker_of(env, metrics).add(batch)[0]


def with_missing(episode: Episode, others: Sequence[Episode]) -> Episode:
    """Return an episode with what only episodes of other games have: metrics, which are undefined in it, and
    what institutions take, give and count, which is 0."""
    metrics = dict(episode.metrics)
    counts = dict(episode.counts or {})
    totals: dict[str, Any] = {}
    for other in others:
        metrics |= {name: nan for name in other.metrics if name not in metrics}
        counts |= {
            name: np.zeros_like(count) for name, count in (other.counts or {}).items() if name not in counts
        }
        for name in AGENT_TOTALS:
            if getattr(episode, name) is None and getattr(other, name) is not None:
                totals[name] = np.zeros_like(getattr(other, name))
    return replace(episode, metrics=metrics, counts=counts or None, **totals)


_RUNNING_TOTALS: Final = {name: total for name, total in TOTALS.items() if total.add is not None}
"""The totals that a tracker adds up for each running episode, beside its steps and returns."""
_TOTALS_OF_EPISODES: Final = {entry.name for entry in fields(Episode)} & ({*TOTALS} - {"counts"})
"""The totals that are fields of an episode, unchanged."""

_REQUIRED_KEYS: Final[Mapping[str, Any]] = {
    "reward": ("next", *keys.REWARD),
    "terminated": ("next", keys.TERMINATED),
    "done": ("next", keys.DONE),
}
"""The keys in a batch of the entries that every game reports, in the form of `ENTRY_KEYS`."""


class _EntryKey(NamedTuple):
    """The place of an entry in a batch, e.g. ("next", "agents") and "reward"."""

    name: str
    group: tuple[str, ...]
    key: str


class _Additions(NamedTuple):
    """The totals to which an entry is added in each turn."""

    entry: str
    skips_zeros: bool
    """True if a turn in which the entry is 0 everywhere changes no total."""
    totals: list[tuple[Any, AnyArray]]
    """Pairs of a function, see `Total.add`, and the total that it adds to."""


class EpisodeTracker:
    """A tracker of the running episode of each world, which returns it when it ends.

    The first batch determines which optional entries (`cprl.measuring.registry`) the game reports; every
    later batch must have them. Fields and metrics that need other entries are left out of episodes.

    Args:
        game: the game, whose yield, institutions and governor decide which metrics there are; None for one
            that is not of cprl.
        metrics: custom metrics; each names a function of an `Episode` that returns a number.

    Raises:
        ValueError: if a number is below 1; in `add`, if a batch has a wrong shape or lacks an entry.
    """

    def __init__(
        self,
        worlds: int,
        agents: int,
        *,
        game: Game | None = None,
        metrics: Sequence[Custom] = (),
    ) -> None:
        self.worlds = checked("worlds", worlds, Positive)
        self.agents = checked("agents", agents, Positive)
        self.reported: tuple[str, ...] | None = None
        """The optional entries of this game; None before the first batch."""
        self._constants = constants_of(game)
        self._count_names = counts_for(game)
        self._metrics = checked("metrics", metrics, tuple[Custom, ...])
        self._episode_numbers = np.zeros(worlds, np.int64)
        self._running_totals: dict[str, AnyArray] = {}
        self._entry_keys: list[_EntryKey] = []
        self._additions: list[_Additions] = []
        self._checked_size: torch.Size | None = None
        """The batch size whose shapes were checked last."""

    def add(self, batch: TensorDictBase | Turn) -> list[Episode]:
        """Add the next turns of all worlds, batch size [B] or [B, T], with the entries of `cprl.keys`.

        Returns:
            The episodes that ended, ordered by turn, then by world.
        """
        tensordict = batch.batch if isinstance(batch, Turn) else batch
        if self.reported is None:
            reported = reported_in(tensordict)
            self._start_counting(reported, self._new_totals(reported, _widths_in(tensordict)))
        turns = self._read_entries(batch, tensordict)
        if tensordict.batch_dims == 1:
            return self._add_turn(turns)
        ended = []
        for turn in range(tensordict.batch_size[1]):
            ended += self._add_turn({name: array[:, turn] for name, array in turns.items()})
        return ended

    @property
    def returns(self) -> Float64:
        """Return a copy of the returns so far of the running episodes, [B, N]; zeros before the first
        turn."""
        returns = self._running_totals.get("return")
        return np.zeros((self.worlds, self.agents)) if returns is None else returns.copy()

    def state_dict(self) -> dict[str, Tensor]:
        arrays = {"episode": self._episode_numbers, **self._running_totals}
        return {name: torch.tensor(array) for name, array in arrays.items()}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Continue exactly from a state that `state_dict` returned.

        Raises:
            ValueError: if the state has other shapes, or is from a game that reports other entries; the
                tracker is then unchanged.
        """
        reported = None
        running: dict[str, AnyArray] = {}
        if "steps" in state:  # else the tracker had seen no batch yet
            entries = {total.entry for name, total in _RUNNING_TOTALS.items() if name in state}
            reported = tuple(entry for entry in ENTRY_KEYS if entry in entries)
            if self.reported not in (None, reported):
                raise ValueError(
                    f"the state is from a game that reports {list(reported)}; allowed: "
                    f"{list(self.reported or ())}, as this game reports"
                )
            widths = {name: state[name].shape[-1] for name in ("counts", "in_force") if name in state}
            running = self._running_totals or self._new_totals(reported, widths)
        arrays = {"episode": self._episode_numbers, **running}
        for name, array in arrays.items():
            shape = list(state[name].shape) if name in state else "missing"
            if shape != list(array.shape):
                raise ValueError(f'"{name}" of the state is {shape}; allowed: {list(array.shape)}')
        arrays = {name: state[name].numpy(force=True).copy() for name in arrays}
        self._episode_numbers = arrays.pop("episode")
        self._start_counting(reported, arrays)

    def _start_counting(self, reported: tuple[str, ...] | None, running: dict[str, AnyArray]) -> None:
        """Read and count these entries from now on."""
        self.reported = reported
        self._running_totals = running
        entry_keys = {**_REQUIRED_KEYS, **{name: ENTRY_KEYS[name] for name in reported or ()}}
        self._entry_keys = [_EntryKey(name, key[:-1], key[-1]) for name, key in entry_keys.items()]
        self._additions = []
        for entry in reported or ():
            totals = [total for total in _RUNNING_TOTALS.values() if total.entry == entry]
            skips_zeros = all(total.skips_zeros for total in totals)
            arrays = [(total.add, running[total.name]) for total in totals]
            self._additions.append(_Additions(entry, skips_zeros, arrays))

    def _new_totals(self, reported: Collection[str], widths: Mapping[str, int]) -> dict[str, AnyArray]:
        """Return the totals of episodes that begin, for a game that reports these entries."""
        sizes = {"N": self.agents, "C": widths.get("counts", 0), "V": widths.get("in_force", 0)}
        zeros: dict[str, AnyArray] = {
            "steps": np.zeros(self.worlds, np.int64),
            "return": np.zeros((self.worlds, self.agents), np.float64),
        }
        for name, total in _RUNNING_TOTALS.items():
            if total.entry in reported:
                zeros[name] = np.zeros((self.worlds, *map(sizes.get, total.axes)), total.dtype)
        return zeros

    def _read_entries(self, batch: TensorDictBase | Turn, tensordict: TensorDictBase) -> TurnArrays:
        """Return all entries as arrays, [B, ...] or [B, T, ...], without a copy if the batch is on the CPU.

        "had_ended", the worlds that had ended before the turn, and the agents' decisions are included only
        if a world has ended now.
        """
        try:
            turn = Turn.of(batch)
            groups: dict[Any, Any] = {
                ("agents",): turn.agents,
                ("next",): turn.next_world,
                ("next", "agents"): turn.next_agents,
            }
            turns: TurnArrays = {name: groups[group][key] for name, group, key in self._entry_keys}
            turns["had_ended"] = turn.world[keys.DONE]
            if isinstance(turns["done"], Tensor):
                turns = {name: tensor.numpy(force=True) for name, tensor in turns.items()}
            if not np.count_nonzero(turns["done"]):  # ten times faster than `any` on so few values
                del turns["had_ended"]
            elif tensordict.get(keys.BALLOTS_DUE, None) is not None:
                turns["decision"] = tensordict[keys.DECISION].numpy(force=True)
        except KeyError as error:
            raise self._missing_entries_error(tensordict) from error
        if tensordict.batch_size != self._checked_size:
            self._check_shapes(turns, tensordict.batch_size)
        return turns

    def _missing_entries_error(self, tensordict: TensorDictBase) -> ValueError:
        """Return the error for a batch that lacks entries, which names their keys."""
        nested_keys = [*((*group, key) for _, group, key in self._entry_keys), (keys.DONE,)]
        missing = [f"({', '.join(key)})" for key in nested_keys if tensordict.get(key, None) is None]
        return ValueError(
            f"the batch lacks {', '.join(missing)}; allowed: batches with rewards, done and terminated, and "
            "the optional entries of the first batch"
        )

    def _check_shapes(self, turns: TurnArrays, size: torch.Size) -> None:
        """Check the shapes of a batch, once per batch size, because checking takes longer than counting."""
        if len(size) not in (1, 2) or size[0] != self.worlds:
            raise ValueError(f"the batch is {list(size)}; allowed: [{self.worlds}] or [{self.worlds}, T]")
        shapes: dict[str, tuple[int, ...]] = {"reward": (self.agents, 1), "decision": (self.agents,)}
        for name, total in _RUNNING_TOTALS.items():
            if name in self._running_totals and total.entry is not None:
                shapes[total.entry] = self._running_totals[name].shape[1:] or (1,)
        for name, array in turns.items():
            allowed = (*size, *shapes.get(name, (1,)))
            if array.shape != allowed:
                raise ValueError(f'"{name}" of the batch is {list(array.shape)}; allowed: {list(allowed)}')
        self._checked_size = size

    def _add_turn(self, turn: TurnArrays) -> list[Episode]:
        self._add_to_totals(turn)
        if "had_ended" not in turn:
            return []
        done = turn["done"][:, 0]
        # A world that had ended before and is stepped again does not end a second time.
        ended = np.flatnonzero(done & ~turn["had_ended"][:, 0])
        episodes = self._finished_episodes(ended, turn) if len(ended) else []
        self._episode_numbers[ended] += 1
        for array in self._running_totals.values():
            array[done] = 0
        return episodes

    def _add_to_totals(self, turn: TurnArrays) -> None:
        steps = self._running_totals["steps"]
        steps += 1
        self._running_totals["return"] += turn["reward"][..., 0]
        for entry, skips_zeros, totals in self._additions:
            value = turn[entry]
            if not skips_zeros or np.count_nonzero(value):
                for add, total in totals:
                    add(total, value, steps)

    def _finished_episodes(self, worlds: AnyArray, turn: TurnArrays) -> list[Episode]:
        """Return the episodes of the E worlds, int64 [E], that end with this turn."""
        totals = self._final_totals(worlds, turn)
        counts = dict[str, AnyArray]()
        if "counts" in totals:
            counts = {name: totals["counts"][..., COUNT_NAMES.index(name)] for name in self._count_names}
        metrics = compute_metrics({**counts, **totals, **self._constants})
        stored = {name: values for name, values in metrics.items() if METRICS[name].is_stored}
        if "in_force" in totals:
            for ballot, decisions in enumerate(totals["in_force"].T):
                stored[f"{IN_FORCE_PREFIX}{ballot}"] = decisions
        episodes = []
        for index, world in enumerate(worlds):
            copied = {name: totals[name][index] for name in _TOTALS_OF_EPISODES if name in totals}
            for name in copied:
                if not TOTALS[name].axes:
                    copied[name] = copied[name].item()
            episode = Episode(
                world=int(world),
                episode=int(self._episode_numbers[world]),
                return_=totals["return"][index],
                metrics={name: float(values[index]) for name, values in stored.items()},
                counts={name: values[index] for name, values in counts.items()} or None,
                **copied,
            )
            added = custom_metrics(self._metrics, episode)
            if added:
                episode = replace(episode, metrics={**episode.metrics, **added})
            episodes.append(episode)
        return episodes

    def _final_totals(self, worlds: AnyArray, turn: TurnArrays) -> dict[str, AnyArray]:
        """Return the totals of the episodes of the E worlds that end with this turn, [E, ...] by name."""
        totals = {name: array[worlds] for name, array in self._running_totals.items()}
        totals["terminated"] = turn["terminated"][worlds, 0]
        for name, pairs in (("hits", "hit_by"), ("tags", "tagged_by")):
            if pairs in totals:
                totals[name] = totals[pairs].sum(1)
        if "decision" in turn:
            totals["decision"] = turn["decision"][worlds]
        if "stock" in turn:
            totals["stock_left"] = turn["stock"][worlds, 0]
            totals["depletion_step"] = np.where(totals["depletion_step"] > 0, totals["depletion_step"], -1)
        return totals


def tracker_of(env: EnvBase, metrics: Sequence[Custom] = ()) -> EpisodeTracker:
    """Return an `EpisodeTracker` for all worlds of an environment, with or without transforms."""
    return EpisodeTracker(
        env.batch_size.numel(), agent_count(env), game=commons_game_of(env), metrics=metrics
    )


def decisions_of(env: EnvBase) -> tuple[str, ...]:
    """Return the titles of the decisions in an episode, in the order of "in_force"."""
    game = commons_game_of(env)
    if game is not None and game.in_force:
        return tuple(ballot.title for ballot in game.in_force)
    (width,) = env.observation_spec[keys.IN_FORCE].shape[env.batch_dims :]
    return tuple(f"decision {number}" for number in range(width))


def _widths_in(tensordict: TensorDictBase) -> dict[str, int]:
    """Return the last axes of "counts" and "in_force" of a batch."""
    entries = {name: tensordict.get(ENTRY_KEYS[name], None) for name in ("counts", "in_force")}
    widths = {name: values.shape[-1] for name, values in entries.items() if values is not None}
    if widths.get("counts", len(COUNT_NAMES)) != len(COUNT_NAMES):
        raise ValueError(
            f'"counts" of the batch has {widths["counts"]} columns; allowed: {len(COUNT_NAMES)}, '
            f"{', '.join(COUNT_NAMES)}"
        )
    return widths
