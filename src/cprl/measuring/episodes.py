"""Episode, the record of one that has ended, and EpisodeTracker, which makes them of batches of turns."""

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from math import isfinite, nan
from types import MappingProxyType
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from cprl import keys
from cprl.commons.game import Game
from cprl.commons.yields import unproven
from cprl.envs.unwrap import agent_count, commons_of
from cprl.institutions import COUNTS, Institution
from cprl.keys import Turn
from cprl.measuring.registry import (
    IN_FORCE,
    METRICS,
    NEEDS,
    OF_INSTITUTIONS,
    OPTIONAL,
    PLACES,
    TOTALS,
    counts_for,
    groups_of,
    measurable,
    measured,
    reported_in,
)
from cprl.values import Custom, Positive, checked, words_of_metric
from cprl.values.arrays import Float64, Int64

Array = NDArray[Any]
Turns = dict[str, Array]
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
    """The replica that played it in a training; outside of one, by default the world."""
    terminated: bool
    """True if the game itself ended, e.g. no apple was left and none could grow; else the episode was
    truncated at its time limit."""
    return_: Float64
    """[N], the undiscounted sum of rewards of each agent."""
    metrics: Mapping[str, float]
    """By the names of `cprl.measuring.registry.METRICS`, then what was decided, as "institutions/in_force_0",
    and those of the user's own; NaN where undefined. Metrics that need entries that the game does not report
    are missing."""
    harvest: Float64 | None = None
    """[N], apples harvested. This field and all below are None if the game does not report the entries that
    they need, see `cprl.measuring.registry.NEEDS`."""
    in_play_steps: Int64 | None = None
    """[N], steps in which the agent was in play."""
    shots: Int64 | None = None
    """[N], beams fired."""
    hits: Int64 | None = None
    """[N], the number of agents hit by each agent's beams, summed over steps."""
    tagged: Int64 | None = None
    """[N], how often each agent was tagged out; by two agents in one step counts once."""
    tagged_by: Int64 | None = None
    """[N, N], how often the agent of the row was tagged by the agent of the column."""
    wanted_return: Float64 | None = None
    """[N], the sum of the rewards that each agent wanted in a training, see `cprl.objectives.rewards`;
    NaN for agents that do not learn. None outside of a training."""
    stock_left: int | None = None
    """Apples on the board at the end."""
    depletion_step: int | None = None
    """The first step that left no apple on the board, or -1."""
    fines: Float64 | None = None
    """[N], what institutions took from each agent, taxes included, in units of reward. This field and all
    below are of games that report what institutions do."""
    transfers: Float64 | None = None
    """[N], what institutions gave each agent."""
    violations: Int64 | None = None
    """[N], steps in which the agent broke a rule of an institution."""
    counts: Mapping[str, Int64] | None = None
    """[N] by name, what the game's institutions counted, see `cprl.measuring.registry.counts_for`."""
    decision: Int64 | None = None
    """[N], what each agent had decided, see `cprl.Game.ballots`; None in games that ask
    nothing."""
    in_force: Float64 | None = None
    """[V], what was decided for this episode: tax rates, quotas, the agent elected."""

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
        """The outcome as text: apples if the game reports a harvest, else returns."""
        if self.harvest is None:
            return f"returns: {', '.join(f'{value:.4g}' for value in self.return_)}"
        left = "" if self.stock_left is None else f"; {self.stock_left} left"
        return f"apples: {', '.join(f'{apples:.0f}' for apples in self.harvest)}{left}"

    @property
    def reported(self) -> tuple[str, ...]:
        """The optional entries that the game reported, see `cprl.measuring.registry`."""
        lacking = {entry for name, needs in NEEDS.items() if getattr(self, name) is None for entry in needs}
        present = {name for name, value in vars(self).items() if value is not None}
        of_law = {TOTALS[name].entry for name in present & {*TOTALS} if TOTALS[name].is_of_institutions}
        kept = [entry for entry in OPTIONAL if entry not in lacking]
        return (*kept, *(entry for entry in OF_INSTITUTIONS if entry in of_law))


def _read_only(array: Array) -> Array:
    """Return an array that shares memory with another and cannot be written into."""
    view = array.view()
    view.flags.writeable = False
    return view


_TAKEN: Final = {
    *(entry.name for entry in fields(Episode)),
    *METRICS,
    *TOTALS,
    *("role", "composition", "restrained_agents", "window_episodes"),
    "replica",
    "agent",
    *("policy", "trained_episodes", "focal", "focal_agent", "focal_agents", "background", "scenario"),
    *("restrained", "runs", "worlds", "response", "chosen"),
}
"""What columns of tables, their labels and other metrics are called."""


def own_name(metric: Custom) -> str:
    """Return what a metric of the user's own is called: as its function."""
    return re.split("[:.]", metric.target)[-1]


def check_own_metrics(metrics: Sequence[Custom]) -> None:
    """Refuse metrics of the user's own with the name of another number of an episode."""
    names = [own_name(metric) for metric in metrics]
    for name, metric in zip(names, metrics, strict=True):
        if not name.isidentifier():
            raise ValueError(f"{metric.target}: a metric is called as its function; allowed: one with a name")
        if name in _TAKEN or name.startswith(("return_", "in_force_")) or names.count(name) > 1:
            raise ValueError(f"{metric.target}: another number of an episode is called {name}; rename it")


def own_metrics(metrics: Sequence[Custom], episode: Episode) -> dict[str, float]:
    """Return the metrics of the user's own of an episode by name; NaN where one is NaN or infinite.

    Raises:
        ValueError: if one fails, or returns no number; with its name.
    """
    if not metrics:
        return {}
    counts = episode.counts
    seen = replace(
        episode,
        metrics=MappingProxyType(episode.metrics),
        counts=counts and MappingProxyType({name: _read_only(array) for name, array in counts.items()}),
    )
    values = {}
    for metric in metrics:
        try:
            with np.errstate(divide="ignore", invalid="ignore"):  # 0 / 0: undefined
                value = metric.make(seen)
                number = float(value)
        except Exception as error:
            raise ValueError(
                f"the metric {metric.target} gives no number of {episode!r}: {error!r}"
            ) from error
        values[own_name(metric)] = number if isfinite(number) else nan
    return values


def try_own_metrics(metrics: Sequence[Custom], env: EnvBase) -> dict[str, dict[str, str]]:
    """Refuse metrics of the user's own that fail on an episode of one turn of an environment: one in which
    nothing happens, and one in which each entry that the game reports is 1.

    Returns:
        "title" and "unit" by their names, of those whose functions have such attributes.
    """
    for entry in (0, 1) if metrics else ():
        batch = env.fake_tensordict().apply(partial(torch.full_like, fill_value=entry))
        batch["done"], batch["next", "done"] = batch["done"] & False, batch["next", "done"] | True
        tracker_of(env, metrics).add(batch)
    words = {own_name(metric): words_of_metric(metric) for metric in metrics}
    return {name: word for name, word in words.items() if word}


_RUNNING: Final = {name: total for name, total in TOTALS.items() if total.add is not None}
"""What a tracker adds up of each running episode, beside its steps and returns."""
_COPIED: Final = {entry.name for entry in fields(Episode)} & ({*TOTALS} - {"counts"})
"""The totals that an episode has as they are."""
_OF_ALL: Final = {name for name, total in TOTALS.items() if not total.axes}
"""Those that are one number of the whole episode."""

_ALWAYS: Final[Mapping[str, Any]] = {
    "reward": ("next", *keys.REWARD),
    "terminated": ("next", keys.TERMINATED),
    "done": ("next", keys.DONE),
}
"""Where a batch has the entries that every game reports, as `PLACES`."""


class EpisodeTracker:
    """Tracks the running episode of each world and returns it when it ends.

    The first batch determines which optional entries (`cprl.measuring.registry`) the game reports; every
    later batch must have them. Fields and metrics that need other entries are left out of episodes.

    Args:
        sustainable_yield: apples per step that the map can sustain; with first_stock, adds yield_share.
        first_stock: apples on the board at the start of an episode.
        institutions: those of the game, which say what is measured of them, see
            `cprl.measuring.registry.measurable`.
        metrics: the user's own: each names a function of an `Episode` that returns a number.

    Raises:
        ValueError: if a number is below 1; in `add`, if a batch has a wrong shape or lacks an entry.
    """

    def __init__(
        self,
        worlds: int,
        agents: int,
        *,
        sustainable_yield: float | None = None,
        first_stock: float | None = None,
        institutions: Sequence[Institution] = (),
        metrics: Sequence[Custom] = (),
    ) -> None:
        self.worlds = checked("worlds", worlds, Positive)
        self.agents = checked("agents", agents, Positive)
        self.reported: tuple[str, ...] | None = None
        """The optional entries of this game; None before the first batch."""
        self._constants: dict[str, Any] = {
            "sustainable_yield": sustainable_yield,
            "first_stock": first_stock,
            "groups": groups_of(institutions),
        }
        self._counts = counts_for(institutions)
        self._metrics = checked("metrics", metrics, tuple[Custom, ...])
        self._episode = np.zeros(worlds, np.int64)
        self._running: dict[str, Array] = {}
        self._places: list[tuple[str, Any, str]] = []
        self._counted: list[tuple[str, bool, list[tuple[Any, Array]]]] = []
        """Of each entry whether turns of zeros add nothing, and how it is added to which totals."""
        self._checked: torch.Size | None = None

    def add(self, batch: TensorDictBase | Turn) -> list[Episode]:
        """Adds the next turns of all worlds, batch size [B] or [B, T], with the entries of `cprl.keys`.

        Returns:
            The episodes that ended, ordered by turn, then by world.
        """
        tensordict = batch.batch if isinstance(batch, Turn) else batch
        if self.reported is None:
            reported = reported_in(tensordict)
            self._begin(reported, self._zeros(reported, _widths_in(tensordict)))
        turns, size = self._read(batch, tensordict), tensordict.batch_size
        if len(size) == 1:
            return self._add_turn(turns)
        return [
            episode
            for turn in range(size[1])
            for episode in self._add_turn({name: array[:, turn] for name, array in turns.items()})
        ]

    @property
    def returns(self) -> Float64:
        """A copy of the returns so far of the running episodes, [B, N]; zeros before the first turn."""
        returns = self._running.get("return")
        return np.zeros((self.worlds, self.agents)) if returns is None else returns.copy()

    def state_dict(self) -> dict[str, Tensor]:
        arrays = {"episode": self._episode, **self._running}
        return {name: torch.tensor(array) for name, array in arrays.items()}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Continues exactly from a state that `state_dict` returned.

        Raises:
            ValueError: if the state has other shapes, or is from a game that reports other entries; the
                tracker is then unchanged.
        """
        reported, running = None, dict[str, Array]()
        if "steps" in state:  # else the tracker had seen no batch
            entries = {total.entry for name, total in _RUNNING.items() if name in state}
            reported = tuple(entry for entry in (*OPTIONAL, *OF_INSTITUTIONS) if entry in entries)
            if self.reported not in (None, reported):
                raise ValueError(
                    f"the state is from a game that reports {list(reported)}; allowed: "
                    f"{list(self.reported or ())}, as this game reports"
                )
            widths = {name: state[name].shape[-1] for name in ("counts", "in_force") if name in state}
            running = self._running or self._zeros(reported, widths)
        arrays = {"episode": self._episode, **running}
        for name, array in arrays.items():
            shape = list(state[name].shape) if name in state else "missing"
            if shape != list(array.shape):
                raise ValueError(f'"{name}" of the state is {shape}; allowed: {list(array.shape)}')
        arrays = {name: state[name].numpy(force=True).copy() for name in arrays}
        self._episode = arrays.pop("episode")
        self._begin(reported, arrays)

    def _begin(self, reported: tuple[str, ...] | None, running: dict[str, Array]) -> None:
        """Reads these entries from now on."""
        self.reported, self._running = reported, running
        places = {**_ALWAYS, **{name: PLACES[name] for name in reported or ()}}
        self._places = [(name, key[:-1], key[-1]) for name, key in places.items()]
        self._counted = []
        for entry in reported or ():
            totals = [total for total in _RUNNING.values() if total.entry == entry]
            added = [(total.add, running[total.name]) for total in totals]
            self._counted.append((entry, all(total.skips_zeros for total in totals), added))

    def _zeros(self, reported: Collection[str], widths: Mapping[str, int]) -> dict[str, Array]:
        """The totals of episodes that begin, of a game that reports these entries."""
        sizes = {"N": self.agents, "C": widths.get("counts", 0), "V": widths.get("in_force", 0)}
        return {
            "steps": np.zeros(self.worlds, np.int64),
            "return": np.zeros((self.worlds, self.agents), np.float64),
            **{
                name: np.zeros((self.worlds, *(sizes[axis] for axis in total.axes)), total.dtype)
                for name, total in _RUNNING.items()
                if total.entry in reported
            },
        }

    def _read(self, batch: TensorDictBase | Turn, tensordict: TensorDictBase) -> Turns:
        """All entries as arrays, [B, ...] or [B, T, ...], without a copy if the batch is on the CPU.

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
            turns: Turns = {name: groups[group][key] for name, group, key in self._places}
            turns["had_ended"] = turn.world[keys.DONE]
            if isinstance(turns["done"], Tensor):
                turns = {name: tensor.numpy(force=True) for name, tensor in turns.items()}
            if not np.count_nonzero(turns["done"]):  # a tenth of the time that `any` takes on so few
                del turns["had_ended"]
            elif tensordict.get(keys.BALLOTS_DUE, None) is not None:
                turns["decision"] = tensordict[keys.DECISION].numpy(force=True)
        except KeyError as error:
            places = [(*group, key) for _, group, key in (*self._places, ("", (), keys.DONE))]
            missing = [f"({', '.join(key)})" for key in places if tensordict.get(key, None) is None]
            raise ValueError(
                f"the batch lacks {', '.join(missing)}; allowed: batches with rewards, done and terminated, "
                "and the optional entries of the first batch"
            ) from error
        if tensordict.batch_size != self._checked:
            self._check(turns, tensordict.batch_size)
        return turns

    def _check(self, turns: Turns, size: torch.Size) -> None:
        """Checks the shapes of a batch, once per batch size, because checking takes longer than counting."""
        if len(size) not in (1, 2) or size[0] != self.worlds:
            raise ValueError(f"the batch is {list(size)}; allowed: [{self.worlds}] or [{self.worlds}, T]")
        shapes: dict[str, tuple[int, ...]] = {"reward": (self.agents, 1), "decision": (self.agents,)}
        for name, total in _RUNNING.items():
            if name in self._running and total.entry is not None:
                shapes[total.entry] = self._running[name].shape[1:] or (1,)
        for name, array in turns.items():
            allowed = (*size, *shapes.get(name, (1,)))
            if array.shape != allowed:
                raise ValueError(f'"{name}" of the batch is {list(array.shape)}; allowed: {list(allowed)}')
        self._checked = size

    def _add_turn(self, turn: Turns) -> list[Episode]:
        self._count(turn)
        if "had_ended" not in turn:
            return []
        done = turn["done"][:, 0]
        # A world that had ended before and is stepped again does not end a second time.
        ended = np.flatnonzero(done & ~turn["had_ended"][:, 0])
        episodes = self._measure(ended, turn) if len(ended) else []
        self._episode[ended] += 1
        for array in self._running.values():
            array[done] = 0
        return episodes

    def _count(self, turn: Turns) -> None:
        steps = self._running["steps"]
        steps += 1
        self._running["return"] += turn["reward"][..., 0]
        for entry, skips_zeros, totals in self._counted:
            value = turn[entry]
            if not skips_zeros or np.count_nonzero(value):
                for add, total in totals:
                    add(total, value, steps)

    def _measure(self, worlds: Array, turn: Turns) -> list[Episode]:
        """Return the episodes of the E worlds, int64 [E], that end with this turn."""
        totals = self._ended(worlds, turn)
        counts = dict[str, Array]()
        if "counts" in totals:
            counts = {name: totals["counts"][..., COUNTS.index(name)] for name in self._counts}
        metrics = measured({**counts, **totals, **self._constants})
        stored = {name: values for name, values in metrics.items() if METRICS[name].is_stored}
        if "in_force" in totals:
            stored |= {f"{IN_FORCE}{place}": values for place, values in enumerate(totals["in_force"].T)}
        episodes = []
        for index, world in enumerate(worlds):
            copied = {name: totals[name][index] for name in _COPIED if name in totals}
            copied |= {name: copied[name].item() for name in _COPIED & _OF_ALL if name in copied}
            episode = Episode(
                world=int(world),
                episode=int(self._episode[world]),
                return_=totals["return"][index],
                metrics={name: float(values[index]) for name, values in stored.items()},
                counts={name: values[index] for name, values in counts.items()} or None,
                **copied,
            )
            added = own_metrics(self._metrics, episode)
            episodes.append(replace(episode, metrics={**episode.metrics, **added}) if added else episode)
        return episodes

    def _ended(self, worlds: Array, turn: Turns) -> dict[str, Array]:
        """Return the totals of the episodes of the E worlds that end with this turn, [E, ...] by name."""
        totals = {name: array[worlds] for name, array in self._running.items()}
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
    """Return an `EpisodeTracker` for all worlds of an environment, with its institutions and what its board
    bears, and metrics of the user's own."""
    return EpisodeTracker(
        env.batch_size.numel(),
        agent_count(env),
        institutions=institutions_of(env),
        metrics=metrics,
        **yield_of(env),
    )


def yield_of_game(game: Game) -> dict[str, float]:
    """Return the sustainable yield of a game, in apples a turn, and its first stock; nothing where no yield
    is proven."""
    if unproven(game.rules):
        return {}
    return {
        "sustainable_yield": game.sustainable_yield,
        "first_stock": float(game.tables.first_stock),
    }


def yield_of(env: EnvBase) -> dict[str, float]:
    """Return the arguments of an `EpisodeTracker` for yield_share; none of a game without a board of cprl."""
    commons = commons_of(env)
    return {} if commons is None else yield_of_game(commons.game)


def institutions_of(env: EnvBase) -> tuple[Institution, ...]:
    """The institutions of a game of cprl, transforms or not; () for another."""
    commons = commons_of(env)
    return () if commons is None else commons.game.institutions


def metrics_of(env: EnvBase, reported: Collection[str]) -> tuple[str, ...]:
    """Return the metrics of episodes of an environment that reports these entries, but for the user's own and
    what is decided."""
    of_board = ("yield_share",) if commons_of(env) is not None else ()
    return (*measurable(reported, institutions_of(env)), *of_board)


def decisions_of(env: EnvBase) -> tuple[str, ...]:
    """What is decided in an episode, in words, in the order of "in_force"."""
    commons = commons_of(env)
    if commons is not None and commons.game.ballots:
        return tuple(ballot.title for ballot in commons.game.ballots)
    (width,) = env.observation_spec[keys.IN_FORCE].shape[env.batch_dims :]
    return tuple(f"decision {number}" for number in range(width))


def _widths_in(tensordict: TensorDictBase) -> dict[str, int]:
    """The last axes of "counts" and "in_force" of a batch."""
    entries = {name: tensordict.get(PLACES[name], None) for name in ("counts", "in_force")}
    widths = {name: values.shape[-1] for name, values in entries.items() if values is not None}
    if widths.get("counts", len(COUNTS)) != len(COUNTS):
        raise ValueError(
            f'"counts" of the batch has {widths["counts"]} columns; allowed: {len(COUNTS)}, '
            f"{', '.join(COUNTS)}"
        )
    return widths
