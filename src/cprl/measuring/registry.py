"""The registry of all totals and metrics of an episode, each defined once.

A total is what the turns of an episode add up to; a metric is a function of totals, and its parameters are
the totals that it needs. The arrays of a tracker, the columns of tables, what is left out where a game lacks
an entry, words, units, bounds, colours and plots all follow from the two lists `TOTALS` and `METRICS`: a new
metric is one entry of `METRICS`.

Sources: [P] Perolat et al., "A multi-agent reinforcement learning model of common-pool resource
appropriation" (2017); [W] Wiatrak, "Governing the Commons with Multi-Agent Reinforcement Learning" (2019);
[O] Ostrom, "Governing the Commons" (1990), whose principles the metrics of institutions belong to.
"""

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from inspect import signature
from math import inf
from typing import Any, Final

import numpy as np
import pyarrow as pa
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from cprl import keys
from cprl.commons.cells import APPLE, Colour
from cprl.commons.game import Game
from cprl.commons.yields import unproven
from cprl.institutions import COUNT_NAMES, Levies, ledger
from cprl.measuring.social import (
    equality,
    equality_between,
    equality_within,
    incomes_of,
    mean_of_defined,
    share_of,
)
from cprl.measuring.welfare import welfare
from cprl.pictures.colours import BLUE, GREEN, GREY, ORANGE, PALETTE, PURPLE, VERMILION
from cprl.values import METRIC_WORDS
from cprl.values.array_types import AnyArray, Float64

COLLECTIVE_RETURN: Final = "collective_return"
EQUALITY: Final = "equality"
INCOME: Final = "income"
INCOME_EQUALITY: Final = "income_equality"
FINES_TOTAL: Final = keys.FINES[-1]
TRANSFERS_TOTAL: Final = keys.TRANSFERS[-1]
VIOLATIONS: Final = COUNT_NAMES[ledger.VIOLATIONS]

INSTITUTIONS: Final = "institutions/"
"""The prefix of the names of metrics of institutions."""
SHARE_UNIT: Final = "0 to 1"
"""The text in place of a unit for numbers from 0 to 1."""
_RATIO: Final = "ratio"
APPLES: Final = "apples"
_STEPS: Final = "steps"
_INT: Final = pa.int32()


@dataclass(frozen=True, kw_only=True)
class Total:
    """A number that the turns of an episode add up to: [N] for agents, [N, N] for pairs, or one number."""

    name: str
    entry: str | None = None
    """The entry of a turn that it is counted from, as the last part of its key in `cprl.keys`; None if every
    game reports it."""
    axes: str = "N"
    """The axes after that of worlds: N agents, C counts, V decisions; "" for the whole episode."""
    dtype: type = np.int64
    column: pa.DataType | None = _INT
    """The type of its column in tables; None for no column."""
    add: Callable[[AnyArray, AnyArray, AnyArray], None] | None = None
    """The function that adds the entry of a turn to the total of running episodes, given their steps so far,
    [B]; None if it follows from other totals, or from the last turn."""
    is_of_institutions: bool = False
    """True if only games with institutions report it."""
    is_logged: bool = False
    """True if it is logged for each agent."""

    @property
    def skips_zeros(self) -> bool:
        """Return whether entries of zeros add nothing to it."""
        return self.add in (_add_entry, _count_harvests, _add_harvest_times, _count_any)


def _add_entry(total: AnyArray, entry: AnyArray, steps: AnyArray) -> None:
    """Add the entry."""
    total += entry


def _count_harvests(total: AnyArray, entry: AnyArray, steps: AnyArray) -> None:
    """Count the steps in which an agent harvests."""
    total += entry > 0


def _add_harvest_times(total: AnyArray, entry: AnyArray, steps: AnyArray) -> None:
    """Add the current step for each agent that harvests."""
    total += (entry > 0) * steps[:, None]


def _count_any(total: AnyArray, entry: AnyArray, steps: AnyArray) -> None:
    """Count the steps in which the entry is true for any agent of its last axis."""
    total += entry.any(-1)


def _keep_last(total: AnyArray, entry: AnyArray, steps: AnyArray) -> None:
    """Keep the entry of the last turn."""
    total[:] = entry


def _keep_first(total: AnyArray, entry: AnyArray, steps: AnyArray) -> None:
    """Keep the entry of the first turn."""
    is_first = steps == 1
    total[is_first] = entry[is_first]


def _note_first_zero_step(total: AnyArray, entry: AnyArray, steps: AnyArray) -> None:
    """Keep the first step in which the entry is 0."""
    if np.count_nonzero(entry) < entry.size:
        is_now = (entry[:, 0] == 0) & (total == 0)
        total[is_now] = steps[is_now]


def _by_name(*entries: Any) -> dict[str, Any]:
    return {entry.name: entry for entry in entries}


def _logged_total(name: str, entry: str, **more: Any) -> Total:
    """Return a total of institutions that is logged for each agent."""
    return Total(name=name, entry=entry, add=_add_entry, is_of_institutions=True, is_logged=True, **more)


_FLOAT_COLUMN: Final[Any] = {"dtype": np.float64, "column": pa.float64()}

TOTALS: Final[Mapping[str, Total]] = _by_name(
    Total(name="return", **_FLOAT_COLUMN),
    Total(name="wanted_return", **_FLOAT_COLUMN),
    Total(name="harvest", entry="harvest", add=_add_entry, **_FLOAT_COLUMN),
    Total(name="harvest_steps", entry="harvest", add=_count_harvests, column=None),
    Total(name="harvest_time", entry="harvest", add=_add_harvest_times, column=None),
    Total(name="steps", axes=""),
    Total(name="in_play_steps", entry="in_play", add=_add_entry),
    Total(name="shots", entry="fired", add=_add_entry),
    Total(name="hit_by", entry="hit_by", axes="NN", add=_add_entry, column=None),
    Total(name="hits", entry="hit_by"),
    Total(name="tagged", entry="tagged_by", add=_count_any),
    Total(name="tagged_by", entry="tagged_by", axes="NN", add=_add_entry, column=None),
    Total(name="tags", entry="tagged_by", column=None),
    Total(name="stock_left", entry="stock", axes=""),
    Total(name="depletion_step", entry="stock", axes="", add=_note_first_zero_step),
    Total(name="terminated", axes="", column=pa.bool_()),
    Total(name="decision", is_of_institutions=True),
    _logged_total(FINES_TOTAL, FINES_TOTAL, **_FLOAT_COLUMN),
    _logged_total(TRANSFERS_TOTAL, TRANSFERS_TOTAL, **_FLOAT_COLUMN),
    _logged_total(VIOLATIONS, "violated"),
    Total(name="counts", entry="counts", axes="NC", add=_keep_last, is_of_institutions=True, column=None),
    *(
        Total(name=name, entry="counts", is_of_institutions=True)
        for name in COUNT_NAMES
        if name != VIOLATIONS
    ),
    Total(
        name="in_force",
        entry="in_force",
        axes="V",
        dtype=np.float64,
        add=_keep_first,
        is_of_institutions=True,
        column=None,
    ),
    Total(
        name="rules",
        entry="in_force",
        axes="V",
        dtype=np.float64,
        add=_add_entry,
        is_of_institutions=True,
        column=None,
    ),
)
"""All totals, in the order of the columns of tables. "hits" and "tags" are the sums of the columns of
`hit_by` and `tagged_by`; "counts" holds the totals after it, by `cprl.institutions.COUNT_NAMES`."""

OPTIONAL_ENTRIES: Final = tuple(
    dict.fromkeys(total.entry for total in TOTALS.values() if total.entry and not total.is_of_institutions)
)
"""The entries that a game may lack, by the last part of their keys; all but "stock" are in "agents"."""
INSTITUTION_ENTRIES: Final = tuple(
    dict.fromkeys(total.entry for total in TOTALS.values() if total.entry and total.is_of_institutions)
)
"""The entries of games with institutions only; all but "in_force" are in "agents"."""
ENTRY_KEYS: Final[Mapping[str, Any]] = {
    **{name: ("next", keys.AGENTS, name) for name in (*OPTIONAL_ENTRIES, *INSTITUTION_ENTRIES)},
    "in_play": keys.IN_PLAY,
    "stock": ("next", keys.STOCK),
    "in_force": ("next", keys.IN_FORCE),
}
"""The keys of optional and institutional entries in a batch, the optional ones first."""
AGENT_TOTALS: Final = tuple(name for name, total in TOTALS.items() if total.is_logged)
"""The totals of institutions that are logged for each agent."""


@dataclass(frozen=True, kw_only=True)
class Metric:
    """A number of a whole episode, computed from its totals."""

    name: str
    """Its name, with the prefix `INSTITUTIONS` for metrics of institutions."""
    words: str
    """Its name for people, e.g. "equality (1 - Gini)"."""
    unit: str
    """Its unit, e.g. "steps"; `SHARE_UNIT` for numbers from 0 to 1."""
    formula: Callable[..., Any]
    """The function from totals of episodes, [..., N] or [...], to float64 [...]. Its parameters are the
    totals that it needs, and constants of the game; "return_" is "return"."""
    colour: Colour = GREY
    """The colour of its lines; those that share a plot differ."""
    plot: str | None = ""
    """The title of the viewer's plot that it shares with others; "" for one of its own, None for none."""
    is_summarised: bool = False
    """True if it is in the summary of a run."""
    is_stored: bool = True
    """True if episodes have it, and tables a column; else it follows from their totals."""
    same_as: str | None = None
    """The metric that it equals in games without payments, or without agents out of play."""
    is_time: bool = False
    """True if it is a number of steps, which the clock of an episode bounds."""

    @cached_property
    def needs(self) -> tuple[str, ...]:
        """Return the totals and constants that it is computed from."""
        return tuple(name.removesuffix("_") for name in signature(self.formula).parameters)

    @cached_property
    def entries(self) -> tuple[str, ...]:
        """Return the entries of a turn that it needs."""
        entries = (TOTALS[name].entry for name in self.needs if name in TOTALS)
        return tuple(dict.fromkeys(entry for entry in entries if entry))

    @property
    def is_of_institutions(self) -> bool:
        return not set(INSTITUTION_ENTRIES).isdisjoint(self.entries) or "groups" in self.needs

    @property
    def title(self) -> str:
        """Return its words and unit, e.g. "survival, steps"."""
        return ", ".join(filter(None, (self.words, self.unit)))


def _institutional(name: str, words: str, unit: str, formula: Callable[..., Any], **display: Any) -> Metric:
    """Return a metric of institutions, which has no plot of its own."""
    options = {"plot": None, **display}
    return Metric(name=f"{INSTITUTIONS}{name}", words=words, unit=unit, formula=formula, **options)


def _ratio(part: Any, whole: Any) -> Any:
    """Return sum_i part_i / sum_i whole_i over agents i; NaN if the denominator is 0."""
    return share_of(part.sum(-1), whole.sum(-1))


_SHARES_PLOT: Final[Any] = {"plot": "Shares of turns, bites, violations, tags"}
_INCOMES_PLOT: Final[Any] = {"plot": "Equality of incomes"}

METRICS: Final[Mapping[str, Metric]] = _by_name(
    # sum_i R_i; what [W] calls "efficiency".
    Metric(
        name=COLLECTIVE_RETURN,
        words="collective return",
        unit=APPLES,
        formula=lambda harvest: harvest.sum(-1),
        colour=ORANGE,
        is_summarised=True,
    ),
    # sum_i (R_i - fines_i + transfers_i), the sum of all returns; also in games without a harvest.
    Metric(
        name=INCOME,
        words="income of all agents together",
        unit=APPLES,
        formula=lambda return_: return_.sum(-1),
        plot=None,
        is_summarised=True,
        is_stored=False,
        same_as=COLLECTIVE_RETURN,
    ),
    # sum_i R_i / T [P]; undefined for an episode without steps.
    Metric(
        name="efficiency",
        words="efficiency",
        unit="apples per step",
        formula=lambda harvest, steps: share_of(harvest.sum(-1), steps),
        colour=ORANGE,
    ),
    # 1 - sum_ij |R_i - R_j| / (2 N sum_i R_i) [P]; what [W] prints as "inequality".
    Metric(
        name=EQUALITY,
        words="equality (1 - Gini)",
        unit=SHARE_UNIT,
        formula=lambda harvest: equality(harvest),
        colour=BLUE,
        is_summarised=True,
    ),
    # The equality of incomes, in games with fines or transfers.
    Metric(
        name=INCOME_EQUALITY,
        words="equality of incomes",
        unit=SHARE_UNIT,
        formula=lambda harvest, fines, transfers: equality(incomes_of(harvest, fines, transfers)),
        colour=BLUE,
        same_as=EQUALITY,
        **_INCOMES_PLOT,
    ),
    # The mean, over the agents with a harvest, of E[t given r_i,t > 0], 1..T [P]: high where apples are
    # still there late. [P] does not define it for agents without a harvest; here they are left out, and
    # pages count them.
    Metric(
        name="sustainability",
        words="sustainability",
        unit=_STEPS,
        formula=lambda harvest_time, harvest_steps: mean_of_defined(share_of(harvest_time, harvest_steps)),
        colour=GREEN,
        is_summarised=True,
        is_time=True,
    ),
    # The step at which the episode ended, 0..T; what [W] calls "sustainability".
    Metric(
        name="survival_steps",
        words="survival",
        unit=_STEPS,
        formula=lambda steps: steps,
        colour=(230, 120, 0),
        is_summarised=True,
        is_time=True,
    ),
    # (N T - agent-steps out of play) / T, in untagged agents per step, 0..N [P].
    Metric(
        name="peace",
        words="peace",
        unit="agents",
        formula=lambda in_play_steps, steps: share_of(in_play_steps.sum(-1), steps),
        colour=PURPLE,
    ),
    # Agent-steps in play / N, 0..T, as in [W]; it also falls when episodes end early.
    Metric(
        name="peacefulness",
        words="peacefulness",
        unit="steps in play per agent",
        formula=lambda in_play_steps: in_play_steps.sum(-1) / in_play_steps.shape[-1],
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
        unit=_RATIO,
        formula=lambda harvest, steps, sustainable_yield, first_stock: share_of(
            harvest.sum(-1), sustainable_yield * steps + first_stock
        ),
        colour=GREEN,
        is_summarised=True,
    ),
    Metric(
        name="stock_left",
        words="stock left at the end",
        unit=APPLES,
        formula=lambda stock_left: stock_left,
        colour=PALETTE[APPLE],
        is_summarised=True,
    ),
    _institutional(FINES_TOTAL, "fines of all", APPLES, lambda fines: fines.sum(-1)),
    _institutional(TRANSFERS_TOTAL, "transfers to all", APPLES, lambda transfers: transfers.sum(-1)),
    _institutional(VIOLATIONS, VIOLATIONS, "turns", lambda violations: violations.sum(-1), colour=VERMILION),
    _institutional(
        "violations_per_step",
        "violations per turn in play",
        SHARE_UNIT,
        lambda violations, in_play_steps: _ratio(violations, in_play_steps),
        colour=VERMILION,
        **_SHARES_PLOT,
    ),
    _institutional("trespasses", "trespasses", "turns", lambda trespasses: trespasses.sum(-1)),
    _institutional("excess_bites", "taken above a quota", "bites", lambda excess_bites: excess_bites.sum(-1)),
    _institutional("closed_bites", "taken while closed", "bites", lambda closed_bites: closed_bites.sum(-1)),
    # Principle 1 [O], boundaries: bites where the agent may bite, places that are open to all included.
    _institutional(
        "own_share_of_bites",
        "bites where one may bite",
        SHARE_UNIT,
        lambda own_bites, foreign_bites: _ratio(own_bites, own_bites + foreign_bites),
        colour=GREEN,
        **_SHARES_PLOT,
    ),
    # Principle 4 [O], monitoring: near p of `Monitoring`.
    _institutional(
        "detection_rate",
        "violations detected",
        SHARE_UNIT,
        lambda detections, violations: _ratio(detections, violations),
        colour=ORANGE,
        **_SHARES_PLOT,
    ),
    # Principle 5 [O], graduated sanctions: violations by agents who were sanctioned before in the episode.
    _institutional(
        "recidivism",
        "violations after a sanction",
        SHARE_UNIT,
        lambda returns_to_violation, violations: _ratio(returns_to_violation, violations),
        colour=PURPLE,
        **_SHARES_PLOT,
    ),
    # Above 1 where tags are sanctioned too.
    _institutional(
        "sanctions_per_violation",
        "sanctions per violation",
        _RATIO,
        lambda sanctions, violations: _ratio(sanctions, violations),
    ),
    # Principle 6 [O], conflict resolution; undefined without a tag.
    _institutional(
        "unjust_share_of_tags",
        "unjust tags",
        SHARE_UNIT,
        lambda unjust_tags, tags: _ratio(unjust_tags, tags),
        colour=BLUE,
        **_SHARES_PLOT,
    ),
    # Principle 8 [O], nested enterprises: of the harvest, and of incomes.
    _institutional(
        "equality_within",
        "equality within groups",
        SHARE_UNIT,
        lambda harvest, groups: equality_within(harvest, groups),
    ),
    _institutional(
        "equality_between",
        "equality between groups",
        SHARE_UNIT,
        lambda harvest, groups: equality_between(harvest, groups),
    ),
    _institutional(
        "income_equality_within",
        "equality of incomes within groups",
        SHARE_UNIT,
        lambda harvest, fines, transfers, groups: equality_within(
            incomes_of(harvest, fines, transfers), groups
        ),
        colour=GREEN,
        **_INCOMES_PLOT,
    ),
    _institutional(
        "income_equality_between",
        "equality of incomes between groups",
        SHARE_UNIT,
        lambda harvest, fines, transfers, groups: equality_between(
            incomes_of(harvest, fines, transfers), groups
        ),
        colour=ORANGE,
        **_INCOMES_PLOT,
    ),
    # In games with a governor: the mean of the number that it sets, and what it wants, of the whole episode.
    Metric(
        name="governor/rule",
        words="mean of what the governor sets",
        unit="rate, share or level",
        formula=lambda rules, steps, objective: share_of(rules[..., -1], steps),
        colour=PURPLE,
    ),
    Metric(
        name="governor/objective",
        words="objective of the governor",
        unit="a turn",
        formula=lambda harvest, fines, transfers, steps, stock_left, objective: objective(
            incomes_of(harvest, fines, transfers), steps, stock_left
        ),
        colour=GREEN,
    ),
)
"""All metrics, in the order of pages and tables."""
IN_FORCE_PREFIX: Final = f"{INSTITUTIONS}in_force_"
"""The prefix of the numbers that say what each ballot decided for an episode."""
SOCIAL_METRICS: Final = tuple(name for name in METRICS if not METRICS[name].is_of_institutions)
"""The metrics of games without institutions."""


def compute_metrics(totals: Mapping[str, Any], names: Iterable[str] = METRICS) -> dict[str, Float64]:
    """Return the metrics whose totals and constants are all given, by name, each float64 [...].

    Args:
        totals: arrays [..., N] or [...] by the names of `TOTALS`; also `constants_of` the game.
        names: the names of the metrics to compute.
    """
    known = {name: value for name, value in totals.items() if value is not None}
    metrics = {}
    for name in names:
        needs = METRICS[name].needs
        if known.keys() >= {*needs}:
            values = METRICS[name].formula(*map(known.get, needs))
            metrics[name] = np.asarray(values, np.float64)
    return metrics


def constants_of(game: Game | None) -> dict[str, Any]:
    """Return what metrics need of a game beside the totals of its episodes, by the names of their parameters.

    "sustainable_yield", in apples per turn, and "first_stock" are given if the game's yield is proven;
    "groups" with `Levies`, of which the first counts; "objective", a function of incomes, turns and the
    apples left, with a governor. For None, a game that is not of cprl, nothing is given.
    """
    constants: dict[str, Any] = {}
    if game is None:
        return constants
    if not unproven(game.rules):
        constants["sustainable_yield"] = game.sustainable_yield
        constants["first_stock"] = float(game.tables.first_stock)
    levies = [institution for institution in game.institutions if isinstance(institution, Levies)]
    if levies:
        constants["groups"] = levies[0].groups
    if game.governor is not None:
        constants["objective"] = partial(welfare, game)
    return constants


def metrics_for(reported: Collection[str], game: Game | None = None) -> tuple[str, ...]:
    """Return the metrics that make sense for a game, in order, without the income, which tables have.

    Args:
        reported: the entries that the game reports, of `OPTIONAL_ENTRIES` and `INSTITUTION_ENTRIES`.
        game: the game; None for one that is not of cprl.
    """
    known = {*counts_for(game), *TOTALS.keys() - {*COUNT_NAMES}, VIOLATIONS, *constants_of(game)}
    return tuple(
        name
        for name, metric in METRICS.items()
        if name != INCOME and known.issuperset(metric.needs) and set(metric.entries) <= set(reported)
    )


def counts_for(game: Game | None) -> tuple[str, ...]:
    """Return the names of `cprl.institutions.COUNT_NAMES` that make sense for a game; all for a game without
    institutions, in which only user code can count."""
    if game is None or not game.institutions:
        return COUNT_NAMES
    counted = {VIOLATIONS, *(count for institution in game.institutions for count in institution.rule.counts)}
    known = set[str]()
    for metric in METRICS.values():
        needed = set(metric.needs) & set(COUNT_NAMES)
        if needed <= counted:
            known |= needed
    return tuple(name for name in COUNT_NAMES if name in known)


def reported_by(env: EnvBase) -> tuple[str, ...]:
    """Return the entries of `OPTIONAL_ENTRIES` and `INSTITUTION_ENTRIES` in the specs of an environment with
    its transforms."""
    entries = set(env.observation_spec.keys(include_nested=True))
    return tuple(name for name in ENTRY_KEYS if {name, (keys.AGENTS, name)} & entries)


def reported_in(tensordict: TensorDictBase) -> tuple[str, ...]:
    """Return the entries of `OPTIONAL_ENTRIES` and `INSTITUTION_ENTRIES` in a batch."""
    return tuple(name for name, key in ENTRY_KEYS.items() if tensordict.get(key, None) is not None)


def is_custom_metric(name: str) -> bool:
    """Return whether a number of an episode is a custom metric."""
    return not (name in METRICS or "/" in name or name.startswith("return_"))


def _metric(name: str) -> Metric:
    """Return a metric by name, with the words of a custom one as far as they are known; for another number
    its name in place of words."""
    if name in METRICS:
        return METRICS[name]
    words: Mapping[str, str] = {}
    hue = GREY
    if is_custom_metric(name):
        words = METRIC_WORDS.get(name, {})
        hue = ORANGE
    return Metric(
        name=name, words=words.get("title", name), unit=words.get("unit", ""), formula=float, colour=hue
    )


def title(name: str) -> str:
    """Return words and unit of a metric, e.g. "survival, steps"; for another number its name."""
    return _metric(name).title


def colour(name: str) -> Colour:
    """Return the colour of a metric's lines."""
    return _metric(name).colour


def unit(name: str) -> str:
    """Return the unit of a number, e.g. "steps"; "" if it has a range instead. A single agent's return is in
    apples."""
    if name.startswith("return_") or name.endswith("/return"):
        return APPLES
    unit = _metric(name).unit
    return "" if unit == SHARE_UNIT else unit


def with_unit(name: str, *, rewards: str = "") -> str:
    """Return the heading of a number in a table, with its unit, e.g. "survival, steps" or "agent 0: return,
    apples".

    Args:
        name: the name of a metric, or of an amount of agents: ".../return", ".../fines", ".../transfers".
        rewards: the unit of rewards; "" if it is unknown.
    """
    if name == INCOME:
        return ", ".join(filter(None, (METRICS[name].words, rewards)))
    if name in METRICS or is_custom_metric(name):
        return title(name)
    if name.startswith(IN_FORCE_PREFIX):
        return f"in force: decision {name.removeprefix(IN_FORCE_PREFIX)}"
    agents, slash, total = name.rpartition("/")
    words = f"{agents.replace('_', ' ')}: {total}" if slash else name
    unit_of = rewards if total in ("return", FINES_TOTAL, TRANSFERS_TOTAL) else ""
    return ", ".join(filter(None, (words, unit_of)))


def bounds(name: str, clock: float = inf) -> tuple[float, float]:
    """Return the lowest and the highest possible value of a number; infinite if there is none.

    Args:
        clock: the steps of the longest episode that the game allows.
    """
    metric = _metric(name)
    if metric.unit == SHARE_UNIT:
        return 0.0, 1.0
    if name == INCOME or name not in METRICS:
        is_amount = name.rpartition("/")[2] in AGENT_TOTALS
        return 0.0 if is_amount else -inf, inf
    return 0.0, clock if metric.is_time else inf


def left_out_note(reported: Collection[str], *, more: Mapping[str, tuple[str, ...]] | None = None) -> str:
    """Return one line about the numbers that are left out, and why; "" for none.

    Args:
        reported: the entries of `OPTIONAL_ENTRIES` that the game reports.
        more: further numbers and the entries that they need, or words for what else the game lacks.
    """
    needs = {name: METRICS[name].entries for name in SOCIAL_METRICS if name not in (INCOME, *TOTALS)}
    lacking: dict[str, list[str]] = {}
    for name, entries in {**needs, **ENTRIES_OF_FIELDS, **(more or {})}.items():
        missing = " and no ".join(entry for entry in entries if entry not in reported)
        if missing and name != "yield_share":
            lacking.setdefault(missing, []).append(name)
    notes = (f"{', '.join(names)} (the game reports no {missing})" for missing, names in lacking.items())
    text = "; ".join(notes)
    return f"left out: {text}" if text else ""


ENTRIES_OF_FIELDS: Final[Mapping[str, tuple[str, ...]]] = {
    **{
        name: (total.entry,)
        for name, total in TOTALS.items()
        if total.entry and total.column is not None and not total.is_of_institutions
    },
    "tagged_by": ("tagged_by",),
}
"""The entries that each field of an `Episode` needs; missing fields need none."""
