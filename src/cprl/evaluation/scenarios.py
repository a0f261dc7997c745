"""Scenarios: agents of a stored run among named backgrounds that they never met, called by their focal agents
and their background, e.g. "minority_among_greedy".

As in Melting Pot (J. Z. Leibo et al., "Scalable Evaluation of Multi-Agent Reinforcement Learning with Melting
Pot", 2021), focal agents, which are judged, share a board with background agents, which are part of the test.
A focal majority receives one of the background agents; a focal minority is one agent among them.

The focal agents are those of the run, each with its own index. Every placement is played by every replica, in
the same worlds for the run's agents and for those that it is held against; a number is a replica's mean over
episodes and placements, estimated over replicas, because only replicas are independent.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeAlias

import numpy as np
import pyarrow as pa

from cprl.commons.game import Game
from cprl.evaluation.cross_play import OF_BACKGROUND, OF_FOCAL
from cprl.evaluation.evaluate import opened, refuse_other_games, refuse_unlike
from cprl.evaluation.lanes import (
    Agent,
    Who,
    agents_of,
    fresh_for,
    frozen,
    play,
    roles_of,
    said,
    scripted,
    together,
)
from cprl.evaluation.pages import heading, row_cells
from cprl.experiment import presets
from cprl.measuring.registry import COLLECTIVE_RETURN, EQUALITY
from cprl.measuring.statistics import Family, differences, estimates
from cprl.measuring.table import FOCAL, where
from cprl.population import Frozen, Scripted
from cprl.system.defaults import Fresh
from cprl.system.working import working
from cprl.terminal import style
from cprl.terminal.panels import draw_dots
from cprl.terminal.summary import OVER_REPLICAS
from cprl.terminal.tables import Cell, Cells, Change
from cprl.training.agents import check_scripted
from cprl.training.stored import LoadedRun, load
from cprl.values import Value, Where, refusal

Focal: TypeAlias = Literal["majority", "minority"]
"""How many agents are focal: "majority", all but one; "minority", one."""


@dataclass(frozen=True, kw_only=True)
class Scenario(Value, stored=False):
    """A background on a board, and how many of the agents are focal."""

    name: Annotated[str, Where(str.isidentifier, "letters, digits and underscores, not a digit first")]
    """What it is called, e.g. "minority_among_greedy"."""
    game: Game
    """The board with its rules, for at least 2 agents; scripted policies need windows as observations."""
    focal: Focal
    """How many agents are focal, see `Focal`; in a game of two agents both are one."""
    background: tuple[Scripted | Frozen, ...]
    """Who plays with each agent index where it is not focal. `Frozen(run, agent, replica=None)` is, beside
    replica r of the focal run, the agent of the next replica that its own run keeps, the first one after
    the last: so agents of one replica, trained together or from the same seed, never meet."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_game(self.game, "Scenario.game")
        if len(self.background) != self.game.agents:
            raise refusal(
                "Scenario.background", self.background, f"one for each of {self.game.agents} agents"
            )

    @property
    def placements(self) -> tuple[Who, ...]:
        """The indices of the focal agents in turn, so that every agent is focal equally often: as a minority
        each alone, as a majority all without agent 0, without agent 1 and so on."""
        everyone = range(self.game.agents)
        is_minority = self.focal == "minority"
        return tuple(
            tuple(agent for agent in everyone if (agent == alone) == is_minority) for alone in everyone
        )


SCRIPTED: Final = ("greedy", "sustainable", "territorial", "aggressive")
"""Backgrounds in which all agents follow one scripted policy."""

STORED: Final = "dqn"
"""The background of the population that DQN trained on the very game, where one is committed."""

_COMMITTED: Final[tuple[tuple[presets.Board, presets.Variant, bool, str], ...]] = (
    ("commons", "as_run", True, "commons"),
    ("commons", "published", True, "commons_published"),
    ("two_complex", "as_run", True, "two_complex"),
    ("two_complex", "as_run", False, "two_complex_no_beam"),
)
"""Board, variant, whether agents may fire, and the folder of `docs/results` with the population."""


def results_folder() -> Path:
    """Return the folder with the results that come with a checkout of cprl, which is `docs/results`; an
    installed wheel has none."""
    return Path(__file__).parents[3] / "docs" / "results"


def stored_for(game: Game) -> Path | None:
    """Return the folder of the committed population that was trained on a game, whether it is at hand or not;
    None if there is none."""
    for board, variant, may_fire, name in _COMMITTED:
        published = presets.game(board, variant=variant)
        if game == replace(published, rules=replace(published.rules, may_fire=may_fire)):
            return results_folder() / name
    return None


def left_out_of(game: Game) -> str:
    """Say which scenarios of a game are not at hand and why; "" if all are."""
    folder = stored_for(game)
    if folder is None or folder.is_dir():
        return ""
    names = " and ".join(f"{focal}_among_{STORED}" for focal in _modes(game))
    return f"{names}: the stored population {folder} comes with a checkout of cprl, and is not there"


def scenarios_of(game: Game) -> tuple[Scenario, ...]:
    """Return all named scenarios of a game: as a majority and as a minority among each of `SCRIPTED`, and
    among the committed population that DQN trained on this very game, if there is one and its folder is at
    hand.

    In a game of two agents a majority and a minority are the same, so that it has the minorities alone.
    Without a beam "territorial" and "aggressive" have nothing to fire, and are left out.
    """
    check_game(game)
    backgrounds: dict[str, tuple[Scripted | Frozen, ...]] = {
        policy: (Scripted(policy),) * game.agents
        for policy in SCRIPTED
        if game.rules.may_fire or policy not in ("territorial", "aggressive")
    }
    folder = stored_for(game)
    if folder is not None and folder.is_dir():
        backgrounds[STORED] = tuple(Frozen(str(folder), agent, replica=None) for agent in range(game.agents))
    return tuple(
        Scenario(name=f"{focal}_among_{name}", game=game, focal=focal, background=background)
        for name, background in backgrounds.items()
        for focal in _modes(game)
    )


def check_game(game: Any, name: str = "the game") -> None:
    if not isinstance(game, Game):
        raise refusal(name, game, "a cprl.Game, because scripted agents read its windows")
    if game.agents < 2:
        raise ValueError(f"{name} has {game.agents} agent; allowed for scenarios: at least 2")
    if game.observation.area != "window":
        raise refusal("Observation.area", game.observation.area, '"window", which scripted agents read')


def _modes(game: Game) -> tuple[Focal, ...]:
    return ("minority",) if game.agents == 2 else ("majority", "minority")


RUN: Final = "run"
FOCAL_AGENTS: Final = (RUN, "random", "greedy")
"""Who takes the focal places: the run's agents, or agents that follow a scripted policy."""
BY: Final = ("scenario", FOCAL)


@working("playing scenarios")
def run_scenarios(
    run: str | Path | LoadedRun,
    fresh: Fresh = Fresh(episodes=5),
    *,
    scenarios: Sequence[str | Scenario] = (),
) -> pa.Table:
    """Let the agents of a stored run play scenarios in the focal places, and random and greedy agents in
    these places, in the same worlds.

    Args:
        fresh: which episodes, in each placement.
        scenarios: names of `scenarios_of` the run's game, or scenarios of your own on the same game; by
            default all that it has.

    Returns:
        A row for each population, replica, episode and agent, see `cprl.measuring.table`, by "scenario",
        "focal", who takes the focal places: "run", "random" or "greedy", and "focal_agents", their indices,
        e.g. "0 2 3".
    """
    loaded = opened(run)
    check_game(loaded.game)
    everyone = range(loaded.game.agents)
    check_scripted([(Scripted("greedy"), tuple(everyone))], loaded.spaces, loaded.game)
    chosen = _chosen(loaded, scenarios)
    specs = [spec for scenario in chosen for spec in scenario.background]
    stored = {path: load(path) for path in {spec.run: None for spec in specs if isinstance(spec, Frozen)}}
    for path, background_run in stored.items():
        refuse_other_games({str(loaded.path): loaded, f"the background {path}": background_run})
    fresh = fresh_for([loaded], fresh, among=stored.values())
    backgrounds = {
        scenario.name: [_background(spec, stored, loaded, fresh.replicas) for spec in scenario.background]
        for scenario in chosen
    }
    populations = {RUN: agents_of(loaded)}
    populations |= {policy: [scripted(policy)] * len(everyone) for policy in FOCAL_AGENTS[1:]}

    def parts(scenario: Scenario) -> Iterator[pa.Table]:
        background = backgrounds[scenario.name]
        for (who, focal), places in product(populations.items(), scenario.placements):
            agents = [focal[agent] if agent in places else background[agent] for agent in everyone]
            labels = {"scenario": scenario.name, FOCAL: who, "focal_agents": " ".join(map(str, places))}
            yield play(fresh, loaded, agents, labels, roles=roles_of(len(everyone), places))

    is_all = {scenario.name for scenario in chosen} >= {one.name for one in scenarios_of(loaded.game)}
    return together(
        (part for scenario in chosen for part in parts(scenario)),
        heading=heading(f"Scenarios of {loaded.path.name}", fresh, [loaded], " in each placement"),
        run=loaded.path.name,
        fresh=fresh,
        weights=loaded.weights_from,
        scenarios_left_out=left_out_of(loaded.game) if is_all else "",
    )


def _chosen(run: LoadedRun, scenarios: Sequence[str | Scenario]) -> list[Scenario]:
    """Return the scenarios by their names or as they are, checked against the run's game."""
    named = {scenario.name: scenario for scenario in scenarios_of(run.game)}
    chosen: dict[str, Scenario] = {}
    for given in scenarios or named:
        if isinstance(given, str) and given not in named:
            raise refusal("a scenario", given, f"{', '.join(named)}; {left_out_of(run.game)}".rstrip("; "))
        scenario = named[given] if isinstance(given, str) else given
        if scenario.name in chosen:
            raise ValueError(f"{scenario.name} is given twice; allowed: scenarios with different names")
        refuse_unlike(f"{run.path} and the scenario {scenario.name}", run.game, scenario.game)
        chosen[scenario.name] = scenario
    return list(chosen.values())


def _background(
    spec: Scripted | Frozen, stored: Mapping[str, LoadedRun], run: LoadedRun, replicas: Sequence[int]
) -> Agent:
    """Return who plays in a background beside these replicas of a run; refuse one that would meet itself."""
    if isinstance(spec, Scripted):
        return scripted(spec.policy)
    other = stored[spec.run]
    if spec.replica is not None:
        return frozen(other, spec)
    beside = {replica: _following(other, replica) for replica in replicas}
    is_alike = other.experiment.seed == run.experiment.seed
    if is_alike and any(replica == number for replica, number in beside.items()):
        raise ValueError(
            f"the background {other.path} keeps the single replica {other.replicas[0]} of the same seed as "
            f"{run.path}; allowed: a run of at least 2 replicas, one of another seed, or a Frozen with the "
            "number of its replica"
        )
    return agents_of(other, beside)[spec.agent]


def _following(run: LoadedRun, replica: int) -> int:
    """Return the number of the replica of a background that plays beside this one: of those that it keeps the
    next, the first after the last."""
    numbers = run.replicas  # some may be missing
    before = numbers.index(replica) if replica in numbers else replica
    return numbers[(before + 1) % len(numbers)]


SOCIAL: Final = (COLLECTIVE_RETURN, EQUALITY, "sustainability", "survival_steps", "peacefulness")
"""The social metrics on the page; others are in the table."""


def advantages(table: pa.Table, numbers: Sequence[str] = (OF_FOCAL, OF_BACKGROUND)) -> Family:
    """Return what the run's agents get more than others would in their places, "focal/return", and what the
    background gets more among them, "background/return", by "scenario" and "focal", these others. Paired by
    replica, which plays the same worlds."""
    behind = differences(table, numbers, BY, {FOCAL: RUN})
    return behind.changed(lambda _, one: -one)


def scenario_cells(table: pa.Table) -> Iterator[Cells]:
    """Yield the returns, a row for each scenario, and social metrics of all agents together."""
    levels = estimates(table, [OF_FOCAL, OF_BACKGROUND], BY)
    ahead = advantages(table, [OF_FOCAL])
    names = list(dict.fromkeys(scenario for scenario, _ in levels.labels))
    others = FOCAL_AGENTS[1:]
    returns: list[list[Cell]] = [
        [
            name,
            *(levels[name, who, OF_FOCAL] for who in FOCAL_AGENTS),
            *(Change(ahead[name, who, OF_FOCAL]) for who in others),
            levels[name, RUN, OF_BACKGROUND],
        ]
        for name in names
    ]
    columns = ["scenario", "focal: the run's agents", *(f"{who} in their place" for who in others)]
    columns += [*(f"run's - {who}'s, paired" for who in others), "background"]
    missing = said(table, "scenarios_left_out")
    note = ahead.note("of this table") + f"\nLeft out: {missing}" * bool(missing)
    yield Cells("return per agent, apples", columns, returns, note)
    social = estimates(where(table, focal=RUN), SOCIAL, "scenario")
    yield row_cells(social, "all agents together, with the run's agents in the focal places")


_LOOKS: Final = {
    (RUN, OF_FOCAL): ("o", style.MEAN, "focal agents: the run's"),
    ("greedy", OF_FOCAL): ("s", style.MARK, "greedy in their place"),
    ("random", OF_FOCAL): ("D", "#8a8a8a", "random in their place"),
    (RUN, OF_BACKGROUND): ("|", "#000000", "background agents, beside the run's"),
}
"""Marker, colour and name of each number."""
_ROW: Final = 4.4
"""The height of a scenario in em."""
_BAND: Final = 0.16
"""The distance between two numbers of a scenario, in rows."""


def draw_scenarios(table: pa.Table, path: Path | str, *, width: style.Width = "page") -> Path:
    """Draw the mean return per agent, a row for each scenario: of the run's agents in the focal places, of
    greedy and of random ones there, and of the background; intervals by Student's t."""
    levels = estimates(table, [OF_FOCAL, OF_BACKGROUND], BY)
    names = list(dict.fromkeys(scenario for scenario, _ in levels.labels))
    rows = np.arange(len(names))
    with style.drawing(path, width=width) as sheet:
        (axes,) = sheet.panels(1, high=_ROW * len(rows) + 4)
        for place, ((who, number), (marker, colour, label)) in enumerate(_LOOKS.items()):
            means = [levels[name, who, number] for name in names]
            at = list(rows + _BAND * (place - (len(_LOOKS) - 1) / 2))
            draw_dots(axes, at, means, across=True, color=colour, marker=marker, label=label)
        for row in rows[1:]:
            axes.axhline(row - 0.5, color="#dddddd", linewidth=0.8)
        axes.set_yticks(rows, [style.wrapped(name.replace("_", " "), 0.3 * sheet.width_em) for name in names])
        axes.set(ylim=(len(rows) - 0.5, -0.5), xlabel="return per agent, apples")
        sheet.title = f"{said(table, 'run')}: returns by scenario"
        sheet.caption = f"{said(table, 'fresh')} in each placement, the same worlds for all; {OVER_REPLICAS}."
    return Path(path)
