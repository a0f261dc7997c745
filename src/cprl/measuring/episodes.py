"""Episode, the record of one that has ended, and EpisodeTracker, which makes them of batches of turns."""

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
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
from cprl.commons.yields import sustainable_yield
from cprl.envs.unwrap import agent_count, commons_of
from cprl.institutions import COUNTS, Institution
from cprl.keys import Turn
from cprl.measuring import institutions, social
from cprl.measuring.metrics import (
    FIELDS,
    INSTITUTIONAL,
    NAMES,
    OF_INSTITUTIONS,
    OPTIONAL,
    PLACES,
    reported_in,
)
from cprl.values import Custom, Positive, checked

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
    return_: NDArray[np.float64]
    """[N], the undiscounted sum of rewards of each agent."""
    metrics: Mapping[str, float]
    """`social.SOCIAL` of the episode, then those of the user's own; NaN where undefined. Metrics that need
    entries that the game does not report are missing."""
    harvest: NDArray[np.float64] | None = None
    """[N], apples harvested. This field and all below are None if the game does not report the entries that
    they need, see `cprl.measuring.metrics.FIELDS`."""
    in_play_steps: NDArray[np.int64] | None = None
    """[N], steps in which the agent was in play."""
    shots: NDArray[np.int64] | None = None
    """[N], beams fired."""
    hits: NDArray[np.int64] | None = None
    """[N], the number of agents hit by each agent's beams, summed over steps."""
    tagged: NDArray[np.int64] | None = None
    """[N], how often each agent was tagged out; by two agents in one step counts once."""
    tagged_by: NDArray[np.int64] | None = None
    """[N, N], how often the agent of the row was tagged by the agent of the column."""
    wanted_return: NDArray[np.float64] | None = None
    """[N], the sum of the rewards that each agent wanted in a training, see `cprl.objectives.preferences`;
    NaN for agents that do not learn. None outside of a training."""
    stock_left: int | None = None
    """Apples on the board at the end."""
    depletion_step: int | None = None
    """The first step that left no apple on the board, or -1."""
    fines: NDArray[np.float64] | None = None
    """[N], what institutions took from each agent, taxes included, in units of reward. This field and all
    below are of games that report what institutions do, see `cprl.measuring.metrics.INSTITUTIONAL`."""
    transfers: NDArray[np.float64] | None = None
    """[N], what institutions gave each agent."""
    violations: NDArray[np.int64] | None = None
    """[N], steps in which the agent broke a rule of an institution."""
    counts: Mapping[str, NDArray[np.int64]] | None = None
    """[N] by name, what the game's institutions counted, see `cprl.measuring.institutions.counts_for`."""
    decision: NDArray[np.int64] | None = None
    """[N], what each agent had decided, see `cprl.Game.ballots`; None in games that ask
    nothing."""
    in_force: NDArray[np.float64] | None = None
    """[V], what was decided for this episode: tax rates, quotas, the agent elected."""
    institutions: Mapping[str, float] = field(default_factory=dict)
    """`cprl.measuring.institutions.METRICS` of the episode; NaN where undefined, empty without
    institutions."""

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
    def social(self) -> dict[str, float]:
        """Each of "Social metrics" in docs/metrics.md that the game reports, and the user's own, by name; NaN
        where undefined."""
        stock = {} if self.stock_left is None else {"stock_left": float(self.stock_left)}
        return {**self.metrics, **stock}

    @property
    def of_institutions(self) -> dict[str, float]:
        """Each of "Institutions" in docs/metrics.md, as `institutions/fines`, and what was decided, as
        `institutions/in_force_0`; NaN where undefined, none of a game without institutions."""
        in_force = () if self.in_force is None else enumerate(self.in_force.tolist())
        values = {**self.institutions, **{f"in_force_{place}": value for place, value in in_force}}
        return {f"institutions/{name}": value for name, value in values.items()}

    @property
    def outcome(self) -> str:
        """The outcome as text: apples if the game reports a harvest, else returns."""
        if self.harvest is None:
            return f"returns: {', '.join(f'{value:.4g}' for value in self.return_)}"
        left = "" if self.stock_left is None else f"; {self.stock_left} left"
        return f"apples: {', '.join(f'{apples:.0f}' for apples in self.harvest)}{left}"

    @property
    def reported(self) -> tuple[str, ...]:
        """The optional entries that the game reported, see `cprl.measuring.metrics`."""
        missing = {entry for name, needs in FIELDS.items() if getattr(self, name) is None for entry in needs}
        more = (entry for name, entry in INSTITUTIONAL.items() if getattr(self, name) is not None)
        return (*(entry for entry in OPTIONAL if entry not in missing), *more)


def _read_only(array: Array) -> Array:
    """Return an array that shares memory with another and cannot be written into."""
    view = array.view()
    view.flags.writeable = False
    return view


_TAKEN: Final = {
    *(entry.name for entry in fields(Episode)),
    *NAMES,
    *COUNTS,
    "return",
    "replica",
    "agent",
    "net",
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
        institutions=MappingProxyType(episode.institutions),
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


def try_own_metrics(metrics: Sequence[Custom], env: EnvBase) -> None:
    """Refuse metrics of the user's own that fail on an episode of one turn of an environment: one in which
    nothing happens, and one in which each entry that the game reports is 1."""
    for entry in (0, 1) if metrics else ():
        batch = env.fake_tensordict().apply(partial(torch.full_like, fill_value=entry))
        batch["done"], batch["next", "done"] = batch["done"] & False, batch["next", "done"] | True
        tracker_of(env, metrics).add(batch)


_RUNNING: Final[Mapping[str, tuple[str, str, type]]] = {
    "harvest": ("harvest", "N", np.float64),
    "harvest_steps": ("harvest", "N", np.int64),
    "harvest_time": ("harvest", "N", np.int64),
    "in_play_steps": ("in_play", "N", np.int64),
    "shots": ("fired", "N", np.int64),
    "hit_by": ("hit_by", "NN", np.int64),
    "tagged": ("tagged_by", "N", np.int64),
    "tagged_by": ("tagged_by", "NN", np.int64),
    "depletion_step": ("stock", "", np.int64),
    "fines": ("fines", "N", np.float64),
    "transfers": ("transfers", "N", np.float64),
    "violations": ("violated", "N", np.int64),
    "counts": ("counts", "NC", np.int64),
    "in_force": ("in_force", "V", np.float64),
}
"""What a tracker adds up of each running episode, by name: the entry that it needs, its axes after that of
worlds (N agents, C counts, V decisions), and its dtype."""


_ADDED: Final = ("in_play_steps", "shots", "hit_by", "tagged_by", "fines", "transfers", "violations")
"""Those to which the entry is added turn by turn."""
_COPIED: Final = {entry.name for entry in fields(Episode)} & ({*_RUNNING} - {"depletion_step", "counts"})
"""Those that an episode has unchanged."""
_TOTALS: Final = {entry.name for entry in fields(social.Totals)} & ({"steps", *_RUNNING} - {"counts"})


_ALWAYS: Final[Mapping[str, Any]] = {
    "reward": ("next", *keys.REWARD),
    "terminated": ("next", keys.TERMINATED),
    "done": ("next", keys.DONE),
}
"""Where a batch has the entries that every game reports, as `PLACES`."""


class EpisodeTracker:
    """Tracks the running episode of each world and returns it when it ends.

    The first batch determines which optional entries (`cprl.measuring.metrics`) the game reports; every later
    batch must have them. Fields and metrics that need other entries are left out of episodes.

    Args:
        sustainable_yield: apples per step that the map can sustain; with first_stock, adds yield_share.
        first_stock: apples on the board at the start of an episode.
        institutions: those of the game, which say what is measured of them, see
            `cprl.measuring.institutions.metrics_for`.
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
        self._yield: dict[str, Any] = {"sustainable_yield": sustainable_yield, "first_stock": first_stock}
        self._institutions, self._metrics = tuple(institutions), tuple(metrics)
        self._episode = np.zeros(worlds, np.int64)
        self._running: dict[str, Array] = {}
        self._places: list[tuple[str, Any, str]] = []
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
    def returns(self) -> NDArray[np.float64]:
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
            entries = {entry for name, (entry, _, _) in _RUNNING.items() if name in state}
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

    def _zeros(self, reported: Collection[str], widths: Mapping[str, int]) -> dict[str, Array]:
        """The totals of episodes that begin, of a game that reports these entries."""
        sizes = {"N": self.agents, "C": widths.get("counts", 0), "V": widths.get("in_force", 0)}
        return {
            "steps": np.zeros(self.worlds, np.int64),
            "return": np.zeros((self.worlds, self.agents), np.float64),
            **{
                name: np.zeros((self.worlds, *(sizes[axis] for axis in axes)), dtype)
                for name, (entry, axes, dtype) in _RUNNING.items()
                if entry in reported
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
        for name, (entry, _, _) in _RUNNING.items():
            if name in self._running:
                shapes[entry] = self._running[name].shape[1:] or (1,)
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
        running, steps = self._running, self._running["steps"]
        steps += 1
        running["return"] += turn["reward"][..., 0]
        if "harvest" in turn and np.count_nonzero(turn["harvest"]):
            bites = turn["harvest"] > 0
            running["harvest"] += turn["harvest"]
            running["harvest_steps"] += bites
            running["harvest_time"] += bites * steps[:, None]
        for name in _ADDED:
            entry, _, _ = _RUNNING[name]
            if entry in turn and np.count_nonzero(turn[entry]):
                running[name] += turn[entry]
        if "tagged_by" in turn and np.count_nonzero(turn["tagged_by"]):
            running["tagged"] += turn["tagged_by"].any(-1)
        if "stock" in turn and np.count_nonzero(turn["stock"]) < turn["stock"].size:
            depletion_step = running["depletion_step"]
            just_now = (turn["stock"][:, 0] == 0) & (depletion_step == 0)
            depletion_step[just_now] = steps[just_now]
        if "counts" in turn:  # they are cumulative: the last turn's are those of the episode
            running["counts"][:] = turn["counts"]
        if "in_force" in turn and np.count_nonzero(first := steps == 1):
            running["in_force"][first] = turn["in_force"][first]

    def _measure(self, worlds: Array, turn: Turns) -> list[Episode]:
        """The episodes of the E worlds, int64 [E], that end with this turn."""
        ended = {name: array[worlds] for name, array in self._running.items()}
        given: dict[str, Any] = {
            name: torch.from_numpy(ended[name]).to(torch.float64) for name in _TOTALS if name in ended
        }
        if "tagged_by" in ended:
            given["tags"] = torch.from_numpy(ended["tagged_by"].sum(1))
        if "counts" in ended:
            given["counts"] = dict(zip(COUNTS, torch.from_numpy(ended["counts"]).unbind(-1), strict=True))
        totals = social.Totals(**given, **self._yield, groups=institutions.groups_of(self._institutions))
        metrics = social.measured(social.SOCIAL, totals)
        wanted = institutions.metrics_for(self._institutions)
        of_institutions = social.measured({name: institutions.METRICS[name] for name in wanted}, totals)
        columns: dict[str, Any] = {name: ended[name] for name in _COPIED if name in ended}
        if "hit_by" in ended:
            columns["hits"] = ended["hit_by"].sum(1)
        if "decision" in turn:
            columns["decision"] = turn["decision"][worlds]
        if "stock" in turn:
            steps = ended["depletion_step"]
            columns["stock_left"] = turn["stock"][worlds, 0].tolist()
            columns["depletion_step"] = np.where(steps > 0, steps, -1).tolist()
        if "counts" in ended:
            counted = institutions.counts_for(self._institutions)
            counts = {name: ended["counts"][..., COUNTS.index(name)] for name in counted}
            columns["counts"] = [
                {name: counts[name][index] for name in counts} for index in range(len(worlds))
            ]
        episodes = []
        for index, world in enumerate(worlds):
            episode = Episode(
                world=int(world),
                episode=int(self._episode[world]),
                steps=int(ended["steps"][index]),
                terminated=bool(turn["terminated"][world, 0]),
                return_=ended["return"][index],
                metrics={name: float(values[index]) for name, values in metrics.items()},
                institutions={name: float(values[index]) for name, values in of_institutions.items()},
                **{name: values[index] for name, values in columns.items()},
            )
            added = own_metrics(self._metrics, episode)
            episodes.append(replace(episode, metrics={**episode.metrics, **added}) if added else episode)
        return episodes


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
    """Return the sustainable yield of a game, in apples a turn, and its first stock."""
    return {
        "sustainable_yield": sustainable_yield(game.map, game.rules),
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
    """The metrics of institutions in episodes of an environment that reports these entries."""
    if set(reported).isdisjoint(OF_INSTITUTIONS):
        return ()
    return tuple(
        name
        for name in institutions.metrics_for(institutions_of(env))
        if set(institutions.METRICS[name].needs) <= set(reported)
    )


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
