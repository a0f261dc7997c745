"""Episode, the record of one that has ended, and EpisodeTracker, which makes them of batches of turns."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields
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
from cprl.measuring import institutions, social
from cprl.measuring.metrics import FIELDS, INSTITUTIONAL, OF_INSTITUTIONS, OPTIONAL, reported_by, reported_in
from cprl.values import Positive, checked

Array = NDArray[Any]
Turns = dict[str, Array]
"""The entries of one turn or several, [B, ...] or [B, T, ...], by the last part of their keys."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Episode:
    """One episode of one world, from its first step to its end. Steps are counted from 1."""

    world: int
    """The index of the world in its batch."""
    episode: int
    """The index of the episode in its world, counted from 0."""
    steps: int
    """Steps played, at least 1."""
    terminated: bool
    """True if the game itself ended, e.g. no apple was left and none could grow; else the episode was
    truncated at its time limit."""
    return_: NDArray[np.float64]
    """[N], the undiscounted sum of rewards of each agent."""
    metrics: dict[str, float]
    """`social.summary` of the episode; NaN where undefined. Metrics that need entries that the game does not
    report are missing."""
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
    """[N], the sum of the rewards that each agent wanted in a training, `cprl.learners.preferences`; NaN for
    agents that do not learn. None outside of a training."""
    stock_left: int | None = None
    """Apples on the board at the end."""
    depletion_step: int | None = None
    """The first step that left no apple on the board, or -1."""
    fines: NDArray[np.float64] | None = None
    """[N], what institutions took from each agent, taxes included, in units of reward. This field and all
    below are of games with institutions, see `cprl.measuring.metrics.INSTITUTIONAL`."""
    transfers: NDArray[np.float64] | None = None
    """[N], what institutions gave each agent."""
    violations: NDArray[np.int64] | None = None
    """[N], steps in which the agent broke a rule of an institution."""
    counts: Mapping[str, NDArray[np.int64]] | None = None
    """[N] by name, what the game's institutions counted, see `cprl.measuring.institutions.counts_for`."""
    decision: NDArray[np.int64] | None = None
    """[N], what each agent had decided, see `cprl.institutions.votes.ballots_of`; None in games that ask
    nothing."""
    in_force: NDArray[np.float64] | None = None
    """[V], what was decided for this episode: tax rates, quotas, the agent elected."""
    institutions: Mapping[str, float] = field(default_factory=dict)
    """`cprl.measuring.institutions.summary` of the episode; NaN where undefined, empty without
    institutions."""

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
        """The optional entries that the game reported, see `cprl.measuring.metrics`."""
        missing = {entry for name, needs in FIELDS.items() if getattr(self, name) is None for entry in needs}
        more = (entry for name, entry in INSTITUTIONAL.items() if getattr(self, name) is not None)
        return (*(entry for entry in OPTIONAL if entry not in missing), *more)


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


class EpisodeTracker:
    """Tracks the running episode of each world and returns it when it ends.

    The first batch determines which optional entries (`cprl.measuring.metrics`) the game reports; every later
    batch must have them. Fields and metrics that need other entries are left out of episodes.

    Args:
        sustainable_yield: apples per step that the map can sustain; with first_stock, adds yield_share.
        first_stock: apples on the board at the start of an episode.
        institutions: those of the game, which say what is measured of them, see
            `cprl.measuring.institutions.metrics_for`.

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
    ) -> None:
        self.worlds = checked("worlds", worlds, Positive)
        self.agents = checked("agents", agents, Positive)
        self.reported: tuple[str, ...] | None = None
        """The optional entries of this game; None before the first batch."""
        self._yield: dict[str, Any] = {"sustainable_yield": sustainable_yield, "first_stock": first_stock}
        self._institutions = tuple(institutions)
        self._episode = np.zeros(worlds, np.int64)
        self._reader = _TurnReader((), worlds=worlds, agents=agents, widths={})
        self._running: dict[str, Array] = {}

    def add(self, tensordict: TensorDictBase) -> list[Episode]:
        """Adds the next turns of all worlds, batch size [B] or [B, T], with the entries of `cprl.keys`.

        Returns:
            The episodes that ended, ordered by turn, then by world.
        """
        if self.reported is None:
            self._begin(reported_in(tensordict), _widths_in(tensordict))
        turns, size = self._reader.read(tensordict), tensordict.batch_size
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
        return {name: torch.tensor(array) for name, array in self._arrays().items()}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Continues exactly from a state that `state_dict` returned.

        Raises:
            ValueError: if the state has other shapes, or is from a game that reports other entries; the
                tracker is then unchanged.
        """
        other = EpisodeTracker(self.worlds, self.agents, **self._yield, institutions=self._institutions)
        if "steps" in state:  # else the tracker had seen no batch
            entries = {entry for name, (entry, _, _) in _RUNNING.items() if name in state}
            reported = tuple(entry for entry in (*OPTIONAL, *OF_INSTITUTIONS) if entry in entries)
            if self.reported not in (None, reported):
                raise ValueError(
                    f"the state is from a game that reports {list(reported)}; allowed: "
                    f"{list(self.reported or ())}, as this game reports"
                )
            widths = {name: state[name].shape[-1] for name in ("counts", "in_force") if name in state}
            other._begin(reported, widths if self.reported is None else self._reader.widths)
        arrays = other._arrays()
        if not set(arrays) <= set(state):
            raise ValueError(f"the state has {sorted(state)}; allowed: at least {sorted(arrays)}")
        for name, array in arrays.items():
            if state[name].shape != array.shape:
                allowed = list(array.shape)
                raise ValueError(f'"{name}" of the state is {list(state[name].shape)}; allowed: {allowed}')
            array[:] = state[name].numpy(force=True)
        vars(self).update(vars(other))

    def _arrays(self) -> dict[str, Array]:
        return {"episode": self._episode, **self._running}

    def _begin(self, reported: tuple[str, ...], widths: Mapping[str, int]) -> None:
        if "harvest" not in reported and self._yield["sustainable_yield"] is not None:
            raise ValueError(
                "sustainable_yield is given; allowed: None, because yield_share needs a harvest, which the "
                "game does not report"
            )
        self.reported = reported
        sizes = {"N": self.agents, "C": widths.get("counts", 0), "V": widths.get("in_force", 0)}
        self._running = {
            "steps": np.zeros(self.worlds, np.int64),
            "return": np.zeros((self.worlds, self.agents), np.float64),
            **{
                name: np.zeros((self.worlds, *(sizes[axis] for axis in axes)), dtype)
                for name, (entry, axes, dtype) in _RUNNING.items()
                if entry in reported
            },
        }
        self._reader = _TurnReader(reported, worlds=self.worlds, agents=self.agents, widths=widths)

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
        metrics, of_institutions = social.of_totals(totals), {}
        if any(name in ended for name in INSTITUTIONAL):
            summary, wanted = institutions.summary(totals), institutions.metrics_for(self._institutions)
            of_institutions = {name: values for name, values in summary.items() if name in wanted}
        counted = institutions.counts_for(self._institutions) if "counts" in ended else ()
        episodes = []
        for index, world in enumerate(worlds):
            more: dict[str, Any] = {name: ended[name][index] for name in _COPIED if name in ended}
            if "hit_by" in ended:
                more["hits"] = ended["hit_by"][index].sum(0)
            if "decision" in turn:
                more["decision"] = turn["decision"][world].copy()
            if "stock" in turn:
                more["stock_left"] = int(turn["stock"][world, 0])
                more["depletion_step"] = int(ended["depletion_step"][index]) or -1
            if "counts" in ended:
                more["counts"] = {name: ended["counts"][index][:, COUNTS.index(name)] for name in counted}
            episodes.append(
                Episode(
                    world=int(world),
                    episode=int(self._episode[world]),
                    steps=int(ended["steps"][index]),
                    terminated=bool(turn["terminated"][world, 0]),
                    return_=ended["return"][index],
                    metrics={name: float(values[index]) for name, values in metrics.items()},
                    institutions={name: float(values[index]) for name, values in of_institutions.items()},
                    **more,
                )
            )
        return episodes


def tracker_of(env: EnvBase) -> EpisodeTracker:
    """Return an `EpisodeTracker` for all worlds of an environment, with its institutions and what its board
    bears."""
    return EpisodeTracker(
        env.batch_size.numel(), agent_count(env), institutions=institutions_of(env), **yield_of(env)
    )


def yield_of_game(game: Game) -> dict[str, float]:
    """Return the sustainable yield of a game, in apples a turn, and its first stock."""
    return {
        "sustainable_yield": sustainable_yield(game.map, game.rules),
        "first_stock": float(len(game.map.sites)),
    }


def yield_of(env: EnvBase) -> Mapping[str, float | None]:
    """Return the arguments of an `EpisodeTracker` for yield_share; None in a game that has no board of cprl,
    or does not report the harvest."""
    commons = commons_of(env)
    if commons is None or "harvest" not in reported_by(env):
        return {"sustainable_yield": None, "first_stock": None}
    return yield_of_game(commons.game)


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
    places: dict[str, Any] = {"counts": ("next", *keys.COUNTS), "in_force": ("next", keys.IN_FORCE)}
    entries = {name: tensordict.get(place, None) for name, place in places.items()}
    widths = {name: values.shape[-1] for name, values in entries.items() if values is not None}
    if widths.get("counts", len(COUNTS)) != len(COUNTS):
        raise ValueError(
            f'"counts" of the batch has {widths["counts"]} columns; allowed: {len(COUNTS)}, '
            f"{', '.join(COUNTS)}"
        )
    return widths


class _TurnReader:
    """Reads the turns of batches that have the same entries, worlds and agents."""

    def __init__(
        self, reported: Collection[str], *, worlds: int, agents: int, widths: Mapping[str, int]
    ) -> None:
        self._worlds, self._agents, self.widths = worlds, agents, widths
        of_worlds = tuple(name for name in reported if name in ("stock", "in_force"))
        self._of_agents = ("reward", *(name for name in reported if name not in ("in_play", *of_worlds)))
        self._of_worlds = (*of_worlds, keys.TERMINATED, keys.DONE)
        self._has_in_play = "in_play" in reported
        self._checked: torch.Size | None = None

    def read(self, tensordict: TensorDictBase) -> Turns:
        """All entries as arrays, [B, ...] or [B, T, ...], without a copy if the batch is on the CPU.

        "had_ended", the worlds that had ended before the turn, is included only if a world has ended now.
        """
        try:
            turns = self._arrays(tensordict)
        except KeyError as error:
            raise self._missing(tensordict) from error
        if tensordict.batch_size != self._checked:
            self._check(turns, tensordict.batch_size)
        return turns

    def _arrays(self, tensordict: TensorDictBase) -> Turns:
        following, entry = keys.entry(tensordict, "next"), keys.entry
        agents = entry(following, keys.AGENTS)
        tensors = {name: entry(agents, name) for name in self._of_agents}
        tensors |= {name: entry(following, name) for name in self._of_worlds}
        if self._has_in_play:
            tensors["in_play"] = entry(entry(tensordict, keys.AGENTS), "in_play")
        had_ended = entry(tensordict, keys.DONE)
        turns = {name: tensor.numpy(force=True) for name, tensor in tensors.items()}
        if np.count_nonzero(turns["done"]):  # a tenth of the time that `any` takes on so few
            turns["had_ended"] = had_ended.numpy(force=True)
            if tensordict.get(keys.BALLOTS_DUE, None) is not None:
                turns["decision"] = entry(entry(tensordict, keys.AGENTS), "decision").numpy(force=True)
        return turns

    def _missing(self, tensordict: TensorDictBase) -> ValueError:
        needed: dict[Any, str] = {keys.DONE: "done"}
        needed |= {("next", name): f"next, {name}" for name in self._of_worlds}
        needed |= {("next", keys.AGENTS, name): f"next, agents, {name}" for name in self._of_agents}
        if self._has_in_play:
            needed[keys.IN_PLAY] = "agents, in_play"
        missing = [f"({name})" for key, name in needed.items() if tensordict.get(key, None) is None]
        return ValueError(
            f"the batch lacks {', '.join(missing)}; allowed: batches with rewards, done and terminated, "
            "and the optional entries of the first batch"
        )

    def _check(self, turns: Turns, size: torch.Size) -> None:
        """Checks the shapes of a batch, once per batch size, because checking takes longer than counting."""
        if len(size) not in (1, 2) or size[0] != self._worlds:
            raise ValueError(f"the batch is {list(size)}; allowed: [{self._worlds}] or [{self._worlds}, T]")
        sizes = {"N": self._agents, "C": self.widths.get("counts"), "V": self.widths.get("in_force"), "1": 1}
        axes = {entry: axes or "1" for entry, axes, _ in _RUNNING.values()}
        axes |= {"reward": "N1", "decision": "N"}
        for name, array in turns.items():
            allowed = (*size, *(sizes[axis] for axis in axes.get(name, "1")))
            if array.shape != allowed:
                raise ValueError(f'"{name}" of the batch is {list(array.shape)}; allowed: {list(allowed)}')
        self._checked = size
