"""All that an episode is counted and measured by, each said once.

A total is what the turns of an episode add up to; a metric is a function of totals, and its parameters are
the totals that it needs. The arrays of a tracker, the columns of tables, what is left out where a game lacks
an entry, words, units, bounds, colours and plots all follow from the two lists `TOTALS` and `METRICS`: a new
metric is one entry of `METRICS`.

Sources: [P] Perolat et al., "A multi-agent reinforcement learning model of common-pool resource
appropriation" (2017); [W] Wiatrak, "Governing the Commons with Multi-Agent Reinforcement Learning" (2019);
[O] Ostrom, "Governing the Commons" (1990), whose principles the metrics of institutions belong to.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from inspect import signature
from math import inf
from typing import Any, Final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from cprl import keys
from cprl.commons.cells import APPLE, Colour
from cprl.institutions import COUNTS, Institution, Levies, ledger
from cprl.measuring.social import (
    Groups,
    equality,
    equality_between,
    equality_within,
    incomes_of,
    mean_of_defined,
    share_of,
)
from cprl.pictures.colours import BLUE, GREEN, GREY, ORANGE, PALETTE, PURPLE, VERMILION
from cprl.values import OWN_METRICS
from cprl.values.arrays import Float64

Array = NDArray[Any]

COLLECTIVE_RETURN: Final = "collective_return"
EQUALITY: Final = "equality"
INCOME: Final = "income"
INCOME_EQUALITY: Final = "income_equality"
FINES: Final = keys.FINES[-1]
TRANSFERS: Final = keys.TRANSFERS[-1]
VIOLATIONS: Final = COUNTS[ledger.VIOLATIONS]

INSTITUTIONS: Final = "institutions/"
"""How the names of metrics begin that are of institutions alone."""
SHARE: Final = "0 to 1"
"""In place of a unit."""
RATIO: Final = "ratio"
APPLES: Final = "apples"
STEPS: Final = "steps"


_INT: Final = pa.int32()


@dataclass(frozen=True, kw_only=True)
class Total:
    """What the turns of an episode add up to: [N] of each agent, [N, N] of pairs, or one number."""

    name: str
    entry: str | None = None
    """The entry of a turn that it is counted from, the last part of its key in `cprl.keys`; None of what
    every game reports."""
    axes: str = "N"
    """After that of worlds: N agents, C counts, V decisions; "" of the whole episode."""
    dtype: type = np.int64
    column: pa.DataType | None = _INT
    """Its type in tables; None where they do not have it."""
    add: Callable[[Array, Array, Array], None] | None = None
    """Adds the entry of a turn to the total of running episodes, given also their steps so far, [B]; None
    for what follows from other totals, or from the last turn."""
    is_of_institutions: bool = False
    """Whether only games with institutions report it; they lack nothing else without it."""
    words: str = ""
    """What it is called where it stands for single agents."""
    unit: str = ""

    @property
    def skips_zeros(self) -> bool:
        """Whether entries of zeros add nothing to it."""
        return self.add in (_sum, _bites, _times_of_bites, _any)


def _sum(total: Array, entry: Array, steps: Array) -> None:
    total += entry


def _bites(total: Array, entry: Array, steps: Array) -> None:
    total += entry > 0


def _times_of_bites(total: Array, entry: Array, steps: Array) -> None:
    total += (entry > 0) * steps[:, None]


def _any(total: Array, entry: Array, steps: Array) -> None:
    total += entry.any(-1)


def _last(total: Array, entry: Array, steps: Array) -> None:
    total[:] = entry


def _first(total: Array, entry: Array, steps: Array) -> None:
    is_first = steps == 1
    total[is_first] = entry[is_first]


def _step_of_first_zero(total: Array, entry: Array, steps: Array) -> None:
    if np.count_nonzero(entry) < entry.size:
        is_now = (entry[:, 0] == 0) & (total == 0)
        total[is_now] = steps[is_now]


def _by_name(*entries: Any) -> dict[str, Any]:
    return {entry.name: entry for entry in entries}


def _of_law(name: str, entry: str, words: str, **more: Any) -> Total:
    return Total(name=name, entry=entry, words=words, add=_sum, is_of_institutions=True, **more)


_MONEY: Final = {"dtype": np.float64, "column": pa.float64(), "unit": APPLES}
_REAL: Final[Any] = {"dtype": np.float64, "column": pa.float64()}
_UNSEEN: Final[Any] = {"column": None}

TOTALS: Final[Mapping[str, Total]] = _by_name(
    Total(name="return", **_REAL),
    Total(name="wanted_return", **_REAL),
    Total(name="harvest", entry="harvest", add=_sum, **_REAL),
    Total(name="harvest_steps", entry="harvest", add=_bites, **_UNSEEN),
    Total(name="harvest_time", entry="harvest", add=_times_of_bites, **_UNSEEN),
    Total(name="steps", axes=""),
    Total(name="in_play_steps", entry="in_play", add=_sum),
    Total(name="shots", entry="fired", add=_sum),
    Total(name="hit_by", entry="hit_by", axes="NN", add=_sum, **_UNSEEN),
    Total(name="hits", entry="hit_by"),
    Total(name="tagged", entry="tagged_by", add=_any),
    Total(name="tagged_by", entry="tagged_by", axes="NN", add=_sum, **_UNSEEN),
    Total(name="tags", entry="tagged_by", **_UNSEEN),
    Total(name="stock_left", entry="stock", axes=""),
    Total(name="depletion_step", entry="stock", axes="", add=_step_of_first_zero),
    Total(name="terminated", axes="", column=pa.bool_()),
    Total(name="decision", is_of_institutions=True),
    _of_law(FINES, FINES, "fined", **_MONEY),
    _of_law(TRANSFERS, TRANSFERS, "given", **_MONEY),
    _of_law(VIOLATIONS, "violated", VIOLATIONS, unit="turns"),
    Total(name="counts", entry="counts", axes="NC", add=_last, is_of_institutions=True, **_UNSEEN),
    *(Total(name=name, entry="counts", is_of_institutions=True) for name in COUNTS if name != VIOLATIONS),
    Total(
        name="in_force",
        entry="in_force",
        axes="V",
        dtype=np.float64,
        add=_first,
        is_of_institutions=True,
        **_UNSEEN,
    ),
)
"""In the order of the columns of tables. "hits" and "tags" are the columns of `hit_by` and `tagged_by`
summed, "counts" the totals that follow it, by `cprl.institutions.COUNTS`."""

OPTIONAL: Final = tuple(
    dict.fromkeys(one.entry for one in TOTALS.values() if one.entry and not one.is_of_institutions)
)
"""The entries that a game may lack, by the last part of their keys; all but "stock" are in "agents"."""
OF_INSTITUTIONS: Final = tuple(
    dict.fromkeys(one.entry for one in TOTALS.values() if one.entry and one.is_of_institutions)
)
"""Those that only games with institutions have; all but "in_force" are in "agents"."""
PLACES: Final[Mapping[str, Any]] = {
    **{name: ("next", keys.AGENTS, name) for name in (*OPTIONAL, *OF_INSTITUTIONS)},
    "in_play": keys.IN_PLAY,
    "stock": ("next", keys.STOCK),
    "in_force": ("next", keys.IN_FORCE),
}
"""The keys of these entries in a batch."""
OF_AGENTS: Final = tuple(name for name, total in TOTALS.items() if total.words)
"""The totals of institutions that are logged of each agent."""


@dataclass(frozen=True, kw_only=True)
class Metric:
    """A number of a whole episode, computed from its totals."""

    name: str
    """With the prefix `INSTITUTIONS` where it is of institutions alone."""
    words: str
    unit: str
    of: Callable[..., Any]
    """From totals of episodes, [..., N] or [...], to float64 [...]. Its parameters are the totals that it
    needs, and constants of the game; "return_" is "return"."""
    colour: Colour = GREY
    """That of its lines; those that share a plot differ."""
    plot: str | None = ""
    """The title of the viewer's plot that it shares with others; "" for one of its own, None for none."""
    is_summarised: bool = False
    """Whether it is in the summary of a run."""
    is_stored: bool = True
    """Whether episodes have it, and tables a column; else it follows from their totals."""
    same_as: str | None = None
    """The metric that it equals where nobody pays anything, or is out of play."""
    is_time: bool = False
    """Whether it is at most the clock of an episode."""

    @cached_property
    def needs(self) -> tuple[str, ...]:
        """The totals and constants that it is computed from."""
        return tuple(name.removesuffix("_") for name in signature(self.of).parameters)

    @cached_property
    def entries(self) -> tuple[str, ...]:
        """The entries of a turn that it needs."""
        entries = (TOTALS[name].entry for name in self.needs if name in TOTALS)
        return tuple(dict.fromkeys(entry for entry in entries if entry))

    @property
    def is_of_institutions(self) -> bool:
        return not set(OF_INSTITUTIONS).isdisjoint(self.entries) or "groups" in self.needs

    @property
    def title(self) -> str:
        """Words and unit, e.g. "survival, steps"."""
        return ", ".join(filter(None, (self.words, self.unit)))


def _institutional(name: str, words: str, unit: str, of: Callable[..., Any], **look: Any) -> Metric:
    plot = look.pop("plot", None)
    return Metric(name=f"{INSTITUTIONS}{name}", words=words, unit=unit, of=of, plot=plot, **look)


def _ratio(part: Any, whole: Any) -> Any:
    """Return sum_i x_i / sum_i y_i; undefined where nothing is in the whole."""
    return share_of(part.sum(-1), whole.sum(-1))


_SHARES: Final[Any] = {"plot": "Shares of turns, bites, violations, tags"}
_INCOMES: Final[Any] = {"plot": "Equality of incomes"}

METRICS: Final[Mapping[str, Metric]] = _by_name(
    # sum_i R_i; what [W] calls "efficiency".
    Metric(
        name=COLLECTIVE_RETURN,
        words="collective return",
        unit=APPLES,
        of=lambda harvest: harvest.sum(-1),
        colour=ORANGE,
    ),
    # sum_i (R_i - fines_i + transfers_i): what all agents are paid. A game without a harvest has it too.
    Metric(
        name=INCOME,
        words="income of all agents together",
        unit=APPLES,
        of=lambda return_: return_.sum(-1),
        plot=None,
        is_stored=False,
        same_as=COLLECTIVE_RETURN,
    ),
    # sum_i R_i / T [P]; undefined for an episode without steps.
    Metric(
        name="efficiency",
        words="efficiency",
        unit="apples per step",
        of=lambda harvest, steps: share_of(harvest.sum(-1), steps),
        colour=ORANGE,
    ),
    # 1 - sum_ij |R_i - R_j| / (2 N sum_i R_i) [P]; what [W] prints as "inequality".
    Metric(
        name=EQUALITY,
        words="equality (1 - Gini)",
        unit=SHARE,
        of=lambda harvest: equality(harvest),
        colour=BLUE,
        is_summarised=True,
    ),
    # The same of incomes; wherever money moves.
    Metric(
        name=INCOME_EQUALITY,
        words="equality of incomes",
        unit=SHARE,
        of=lambda harvest, fines, transfers: equality(incomes_of(harvest, fines, transfers)),
        colour=BLUE,
        same_as=EQUALITY,
        **_INCOMES,
    ),
    # The mean, over the agents with a harvest, of E[t given r_i,t > 0], 1..T [P]: high where apples are
    # still there late. [P] does not define it for agents without a harvest; here they are left out, and
    # pages count them.
    Metric(
        name="sustainability",
        words="sustainability",
        unit=STEPS,
        of=lambda harvest_time, harvest_steps: mean_of_defined(share_of(harvest_time, harvest_steps)),
        colour=GREEN,
        is_summarised=True,
        is_time=True,
    ),
    # The step at which the episode ended, 0..T; what [W] calls "sustainability".
    Metric(
        name="survival_steps",
        words="survival",
        unit=STEPS,
        of=lambda steps: steps,
        colour=(230, 120, 0),
        is_summarised=True,
        is_time=True,
    ),
    # (N T - agent-steps out of play) / T, in untagged agents per step, 0..N [P].
    Metric(
        name="peace",
        words="peace",
        unit="agents",
        of=lambda in_play_steps, steps: share_of(in_play_steps.sum(-1), steps),
        colour=PURPLE,
    ),
    # Agent-steps in play / N, 0..T, as in [W]; it also falls when episodes end early.
    Metric(
        name="peacefulness",
        words="peacefulness",
        unit="steps in play per agent",
        of=lambda in_play_steps: in_play_steps.sum(-1) / in_play_steps.shape[-1],
        colour=PURPLE,
        is_summarised=True,
        same_as="survival_steps",
        is_time=True,
    ),
    # sum_i R_i / (sustainable_yield x T + first_stock): the harvest relative to what the map can bear in
    # the T steps that were played. Of two episodes with the same harvest the shorter one has the higher
    # share, as agents have who take all at once and end the episode. Above 1 where the true yield exceeds
    # the given lower bound.
    Metric(
        name="yield_share",
        words="yield share of the steps played",
        unit=RATIO,
        of=lambda harvest, steps, sustainable_yield, first_stock: share_of(
            harvest.sum(-1), sustainable_yield * steps + first_stock
        ),
        colour=GREEN,
        is_summarised=True,
    ),
    Metric(
        name="stock_left",
        words="stock left at the end",
        unit=APPLES,
        of=lambda stock_left: stock_left,
        colour=PALETTE[APPLE],
        is_summarised=True,
    ),
    _institutional(FINES, "fines of all", APPLES, lambda fines: fines.sum(-1)),
    _institutional(TRANSFERS, "transfers to all", APPLES, lambda transfers: transfers.sum(-1)),
    _institutional(VIOLATIONS, VIOLATIONS, "turns", lambda violations: violations.sum(-1), colour=VERMILION),
    _institutional(
        "violations_per_step",
        "violations per turn in play",
        SHARE,
        lambda violations, in_play_steps: _ratio(violations, in_play_steps),
        colour=VERMILION,
        **_SHARES,
    ),
    _institutional("trespasses", "trespasses", "turns", lambda trespasses: trespasses.sum(-1)),
    _institutional("excess_bites", "taken above a quota", "bites", lambda excess_bites: excess_bites.sum(-1)),
    _institutional("closed_bites", "taken while closed", "bites", lambda closed_bites: closed_bites.sum(-1)),
    # Principle 1 [O], boundaries: bites where the agent may bite, places that are open to all included.
    _institutional(
        "own_share_of_bites",
        "bites where one may bite",
        SHARE,
        lambda own_bites, foreign_bites: _ratio(own_bites, own_bites + foreign_bites),
        colour=GREEN,
        **_SHARES,
    ),
    # Principle 4 [O], monitoring: near p of `Monitoring`.
    _institutional(
        "detection_rate",
        "violations detected",
        SHARE,
        lambda detections, violations: _ratio(detections, violations),
        colour=ORANGE,
        **_SHARES,
    ),
    # Principle 5 [O], graduated sanctions: violations by agents who were sanctioned before in the episode.
    _institutional(
        "recidivism",
        "violations after a sanction",
        SHARE,
        lambda returns_to_violation, violations: _ratio(returns_to_violation, violations),
        colour=PURPLE,
        **_SHARES,
    ),
    # Above 1 where tags are sanctioned too.
    _institutional(
        "sanctions_per_violation",
        "sanctions per violation",
        RATIO,
        lambda sanctions, violations: _ratio(sanctions, violations),
    ),
    # Principle 6 [O], conflict resolution; undefined without a tag.
    _institutional(
        "unjust_share_of_tags",
        "unjust tags",
        SHARE,
        lambda unjust_tags, tags: _ratio(unjust_tags, tags),
        colour=BLUE,
        **_SHARES,
    ),
    # Principle 8 [O], nested enterprises: of the harvest, and of incomes.
    _institutional(
        "equality_within",
        "equality within groups",
        SHARE,
        lambda harvest, groups: equality_within(harvest, groups),
    ),
    _institutional(
        "equality_between",
        "equality between groups",
        SHARE,
        lambda harvest, groups: equality_between(harvest, groups),
    ),
    _institutional(
        "income_equality_within",
        "equality of incomes within groups",
        SHARE,
        lambda harvest, fines, transfers, groups: equality_within(
            incomes_of(harvest, fines, transfers), groups
        ),
        colour=GREEN,
        **_INCOMES,
    ),
    _institutional(
        "income_equality_between",
        "equality of incomes between groups",
        SHARE,
        lambda harvest, fines, transfers, groups: equality_between(
            incomes_of(harvest, fines, transfers), groups
        ),
        colour=ORANGE,
        **_INCOMES,
    ),
)
"""In the order of pages and tables."""
IN_FORCE: Final = f"{INSTITUTIONS}in_force_"
"""How the numbers begin that say what each ballot decided for an episode."""
SOCIAL: Final = tuple(name for name in METRICS if not METRICS[name].is_of_institutions)
"""Those that say something of every game, as far as it reports their entries."""


def measured(totals: Mapping[str, Any], names: Iterable[str] = METRICS) -> dict[str, Float64]:
    """Return the metrics all of whose totals and constants are given, by name, each float64 [...].

    Args:
        totals: by the names of `TOTALS`, arrays [..., N] or [...]; and the constants "sustainable_yield",
            "first_stock" and "groups" of a game that has them.
        names: of the metrics that are asked for.
    """
    given = {name for name, value in totals.items() if value is not None}
    return {
        name: np.asarray(METRICS[name].of(*(totals[need] for need in METRICS[name].needs)), np.float64)
        for name in names
        if given.issuperset(METRICS[name].needs)
    }


def measurable(reported: Collection[str], institutions: Sequence[Institution] = ()) -> tuple[str, ...]:
    """Return the metrics that say something of the episodes of a game, in order; but for the income, which
    tables have, and the yield share.

    Args:
        reported: the entries that the game reports, of `OPTIONAL` and `OF_INSTITUTIONS`.
        institutions: its institutions. Of a game with none, whose entries are somebody's own, all but those
            of groups.
    """
    known = {*counts_for(institutions), *(name for name in TOTALS if name not in COUNTS), VIOLATIONS}
    known |= {"groups"} if groups_of(institutions) is not None else set()
    return tuple(
        name
        for name, metric in METRICS.items()
        if name != INCOME and known.issuperset(metric.needs) and set(metric.entries) <= set(reported)
    )


def counts_for(institutions: Sequence[Institution]) -> tuple[str, ...]:
    """Return the names of `cprl.institutions.COUNTS` that say something of a game with these institutions; of
    a game with none, whose entries are somebody's own, all."""
    counted = {VIOLATIONS, *(count for one in institutions for count in one.rule.counts)}
    if not institutions:
        return COUNTS
    needed = (set(metric.needs) & set(COUNTS) for metric in METRICS.values())
    known = set[str]().union(*(names for names in needed if names <= counted))
    return tuple(name for name in COUNTS if name in known)


def groups_of(institutions: Sequence[Institution]) -> Groups | None:
    """Return the groups of nested enterprises, those of the first `Levies`; None without one."""
    return next((one.groups for one in institutions if isinstance(one, Levies)), None)


def reported_by(env: EnvBase) -> tuple[str, ...]:
    """Return the entries of `OPTIONAL` and `OF_INSTITUTIONS` in the specs of an environment, transforms
    included."""
    entries = set(env.observation_spec.keys(include_nested=True))
    return tuple(name for name in PLACES if {name, (keys.AGENTS, name)} & entries)


def reported_in(tensordict: TensorDictBase) -> tuple[str, ...]:
    """Return the entries of `OPTIONAL` and `OF_INSTITUTIONS` in a batch."""
    return tuple(name for name, key in PLACES.items() if tensordict.get(key, None) is not None)


def is_own(name: str) -> bool:
    """Return whether a number of an episode is a metric of the user's own."""
    return not (name in METRICS or "/" in name or name.startswith("return_"))


def _metric(name: str) -> Metric | None:
    """Return a metric, of the user's own as far as its words are known; None of another number."""
    if name in METRICS or not is_own(name):
        return METRICS.get(name)
    words = OWN_METRICS.get(name, {})
    return Metric(
        name=name, words=words.get("title", name), unit=words.get("unit", ""), of=float, colour=ORANGE
    )


def title(name: str) -> str:
    """Return words and unit of a metric, e.g. "survival, steps"; the name itself if it is none."""
    metric = _metric(name)
    return name if metric is None else metric.title


def colour(name: str) -> Colour:
    """Return the colour of a metric's lines."""
    metric = _metric(name)
    return GREY if metric is None else metric.colour


def unit(name: str) -> str:
    """Return the unit after a value, e.g. "steps"; "" where a range stands for one. A single agent's return
    is in apples."""
    if name.startswith("return_") or name.endswith("/return"):
        return APPLES
    metric = _metric(name)
    return "" if metric is None or metric.unit == SHARE else metric.unit


def with_unit(name: str, *, rewards: str = "") -> str:
    """Return what a table calls a number, with its unit, e.g. "survival, steps" or "agent 0: return, apples".

    Args:
        name: of a metric, or of what agents get or pay: ".../return", ".../fines", ".../transfers".
        rewards: the unit of rewards; "" if the game does not say.
    """
    if name == INCOME:
        return ", ".join(filter(None, (METRICS[name].words, rewards)))
    if _metric(name) is not None:
        return title(name)
    who, slash, what = name.rpartition("/")
    if name.startswith(IN_FORCE):
        return f"in force: decision {name.removeprefix(IN_FORCE)}"
    unit_of = rewards if what in ("return", FINES, TRANSFERS) else ""
    return ", ".join(filter(None, (f"{who.replace('_', ' ')}: {what}" if slash else name, unit_of)))


def bounds(name: str, clock: float = inf) -> tuple[float, float]:
    """Return what a number can be, as far as that is known; of a return, anything.

    Args:
        clock: the steps of the longest episode that the game allows.
    """
    metric = _metric(name)
    if metric is not None and metric.unit == SHARE:
        return 0.0, 1.0
    if metric is None or name == INCOME or name not in METRICS:
        is_amount = name.rpartition("/")[2] in OF_AGENTS
        return 0.0 if is_amount else -inf, inf
    return 0.0, clock if metric.is_time else inf


def left_out(reported: Collection[str], *, more: Mapping[str, tuple[str, ...]] | None = None) -> str:
    """Return one line with the numbers that are left out, and why; "" if there are none.

    Args:
        reported: the entries of `OPTIONAL` that the game reports.
        more: further names and the entries that they need; other words say what else the game lacks.
    """
    needs = {name: METRICS[name].entries for name in SOCIAL if name not in (INCOME, *TOTALS)}
    lacking: dict[str, list[str]] = {}
    for name, entries in {**needs, **NEEDS, **(more or {})}.items():
        missing = " and no ".join(entry for entry in entries if entry not in reported)
        if missing and name != "yield_share":
            lacking.setdefault(missing, []).append(name)
    parts = (f"{', '.join(names)} (the game reports no {missing})" for missing, names in lacking.items())
    text = "; ".join(parts)
    return f"left out: {text}" if text else ""


def _entries_of(totals: Iterable[Total]) -> dict[str, tuple[str, ...]]:
    return {one.name: (one.entry,) for one in totals if one.entry and one.column is not None}


NEEDS: Final[Mapping[str, tuple[str, ...]]] = {
    **_entries_of(one for one in TOTALS.values() if not one.is_of_institutions),
    "tagged_by": ("tagged_by",),
}
"""The entries that each field of an `Episode` needs; other fields need none."""
