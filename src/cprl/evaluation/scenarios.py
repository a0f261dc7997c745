"""Scenarios: agents of a stored run play among background agents that they never met.

As in Melting Pot (J. Z. Leibo et al., "Scalable Evaluation of Multi-Agent Reinforcement Learning with Melting
Pot", 2021), focal agents, which are evaluated, share a board with background agents, which are part of the
test. A focal majority plays with one background agent; a focal minority is one agent among background agents.
The scenario "minority_among_greedy" has one focal agent among greedy agents.

The focal agents are those of the run, each at its own index. Every replica plays every placement of the focal
agents. Random and greedy agents play in the focal places too, in the same worlds, for comparison. A result is
the mean over episodes and placements, estimated over replicas, because only replicas are independent.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeAlias

import numpy as np
import pyarrow as pa

from cprl.commons.game import Game
from cprl.evaluation.cross_play import BACKGROUND_RETURN, FOCAL_RETURN
from cprl.evaluation.pages import heading, row_table
from cprl.evaluation.populations import (
    AgentOfReplica,
    agents_of,
    fresh_for,
    frozen_agent,
    join_tables,
    play_fresh,
    roles_of,
    scripted_agent,
    table_note,
)
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
from cprl.terminal.text_tables import Change, TableCell, TextTable
from cprl.training.agents import check_scripted
from cprl.training.stored import LoadedRun, as_loaded, load, refuse_other_games, refuse_unlike
from cprl.values import Value, Where, refusal

Focal: TypeAlias = Literal["majority", "minority"]
"""How many agents of a scenario are focal: in a "majority" all but one, in a "minority" one."""


@dataclass(frozen=True, kw_only=True)
class Scenario(Value, stored=False):
    """A game, its background agents, and how many of its agents are focal."""

    name: Annotated[str, Where(str.isidentifier, "letters, digits and underscores, not a digit first")]
    """The name of the scenario, e.g. "minority_among_greedy"."""
    game: Game
    """The game, for at least 2 agents. Scripted policies need windows as observations."""
    focal: Focal
    """Whether the focal agents are a majority or a minority. With two agents both are one agent."""
    background: tuple[Scripted | Frozen, ...]
    """The background agent for each index, which plays unless this index is focal. With replica r of the
    focal run, `Frozen(run, agent, replica=None)` plays as the agent of the frozen run's replica after r
    (after the last, the first), so that agents of one replica, trained together or from the same seed, never
    meet."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_game(self.game, "Scenario.game")
        if len(self.background) != self.game.agents:
            raise refusal(
                "Scenario.background", self.background, f"one for each of {self.game.agents} agents"
            )

    @property
    def placements(self) -> list[tuple[int, ...]]:
        """Return the indices of the focal agents in each placement.

        Every agent is focal equally often: a minority is each agent in turn, and a majority leaves out each
        agent in turn.
        """
        agents = tuple(range(self.game.agents))
        if self.focal == "minority":
            return [(agent,) for agent in agents]
        return [agents[:left_out] + agents[left_out + 1 :] for left_out in agents]


SCRIPTED: Final = ("greedy", "sustainable", "territorial", "aggressive")
"""Backgrounds in which all agents follow one scripted policy, each named after the policy."""

STORED: Final = "dqn"
"""The background of agents that DQN trained on the same game, for games with committed agents."""

_COMMITTED: Final[tuple[tuple[presets.Board, presets.Variant, bool, str], ...]] = (
    ("commons", "as_run", True, "commons"),
    ("commons", "published", True, "commons_published"),
    ("two_complex", "as_run", True, "two_complex"),
    ("two_complex", "as_run", False, "two_complex_no_beam"),
)
"""The committed populations: board, variant, whether agents may fire, and their folder in `docs/results`."""


def results_folder() -> Path:
    """Return the folder `docs/results` of a checkout of cprl; with an installed wheel it does not exist."""
    return Path(__file__).parents[3] / "docs" / "results"


def stored_for(game: Game) -> Path | None:
    """Return the folder of the committed population that was trained on a game; None if there is none.

    The folder exists only in a checkout of cprl.
    """
    for board, variant, may_fire, name in _COMMITTED:
        published = presets.game(board, variant=variant)
        if game == replace(published, rules=replace(published.rules, may_fire=may_fire)):
            return results_folder() / name
    return None


def left_out_of(game: Game) -> str:
    """Return in words which scenarios of a game are missing and why; "" if none is."""
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
    """Refuse a game that scripted agents cannot play, or that has fewer than two agents."""
    if not isinstance(game, Game):
        raise refusal(name, game, "a cprl.Game, because scripted agents read its windows")
    if game.agents < 2:
        raise ValueError(f"{name} has {game.agents} agent; allowed for scenarios: at least 2")
    if game.observation.area != "window":
        raise refusal("Observation.area", game.observation.area, '"window", which scripted agents read')


def _modes(game: Game) -> tuple[Focal, ...]:
    """Return the kinds of scenarios of a game; with two agents a majority and a minority are the same."""
    return ("minority",) if game.agents == 2 else ("majority", "minority")


RUN_AGENTS: Final = "run"
FOCAL_AGENTS: Final = (RUN_AGENTS, "random", "greedy")
"""The agents that take the focal places: those of the run, or agents that follow a scripted policy."""
BY: Final = ("scenario", FOCAL)
"""The labels of a result."""


@working("playing scenarios")
def run_scenarios(
    run: str | Path | LoadedRun,
    fresh: Fresh = Fresh(episodes=5),
    *,
    scenarios: Sequence[str | Scenario] = (),
) -> pa.Table:
    """Let the agents of a stored run play scenarios as the focal agents.

    Random and greedy agents play in the same places and worlds, for comparison.

    Args:
        run: the directory of the run, its exported results, or a value of `cprl.load`.
        fresh: the number of episodes in each placement, their seed, and the replicas that play.
        scenarios: names from `scenarios_of` the run's game, or scenarios of one's own for the same game; by
            default all that the game has.

    Returns:
        A table with a row for each scenario, focal agents, placement, replica, episode and agent, see
        `cprl.measuring.table`. The column "scenario" has the scenario's name, "focal" says "run", "random" or
        "greedy", and "focal_agents" has the indices of the focal agents, e.g. "0 2 3".

    Raises:
        ValueError: for a game that scripted agents cannot play, an unknown scenario, one of another game or
            given twice, background agents that were trained with the run's agents, or a seed with which a run
            was trained.
    """
    loaded = as_loaded(run)
    chosen = _choose_scenarios(loaded, scenarios)
    count = loaded.game.agents
    check_scripted([(Scripted("greedy"), tuple(range(count)))], loaded.spaces, loaded.game)
    background_runs = _load_background_runs(loaded, chosen)
    fresh = fresh_for([loaded], fresh, other_runs=background_runs.values())

    backgrounds = {}
    for scenario in chosen:
        backgrounds[scenario.name] = [
            _background_agent(spec, background_runs, loaded, fresh.replicas) for spec in scenario.background
        ]
    populations = {RUN_AGENTS: agents_of(loaded)}
    for policy in FOCAL_AGENTS[1:]:
        populations[policy] = [scripted_agent(policy)] * count

    def placement_tables() -> Iterator[pa.Table]:
        for scenario in chosen:
            background = backgrounds[scenario.name]
            for (name, focal), placement in product(populations.items(), scenario.placements):
                agents = [focal[agent] if agent in placement else background[agent] for agent in range(count)]
                indices = " ".join(map(str, placement))
                labels = {"scenario": scenario.name, FOCAL: name, "focal_agents": indices}
                yield play_fresh(fresh, loaded, agents, labels, roles=roles_of(count, placement))

    return join_tables(
        placement_tables(),
        heading=heading(f"Scenarios of {loaded.path.name}", fresh, [loaded], " in each placement"),
        run=loaded.path.name,
        fresh=fresh,
        weights=loaded.weights_from,
        scenarios_left_out="" if scenarios else left_out_of(loaded.game),
    )


def _load_background_runs(run: LoadedRun, scenarios: Sequence[Scenario]) -> dict[str, LoadedRun]:
    """Load the runs of all frozen background agents, by their paths; refuse runs of other games."""
    background_runs: dict[str, LoadedRun] = {}
    for scenario in scenarios:
        for spec in scenario.background:
            if isinstance(spec, Frozen) and spec.run not in background_runs:
                background_run = background_runs[spec.run] = load(spec.run)
                refuse_other_games({str(run.path): run, f"the background {spec.run}": background_run})
    return background_runs


def _choose_scenarios(run: LoadedRun, scenarios: Sequence[str | Scenario]) -> list[Scenario]:
    """Return the scenarios that are given by name or as values; refuse those of another game."""
    by_name = {scenario.name: scenario for scenario in scenarios_of(run.game)}
    chosen: dict[str, Scenario] = {}
    for choice in scenarios or by_name:
        if isinstance(choice, str) and choice not in by_name:
            allowed = f"{', '.join(by_name)}; {left_out_of(run.game)}".rstrip("; ")
            raise refusal("a scenario", choice, allowed)
        scenario = by_name[choice] if isinstance(choice, str) else choice
        if scenario.name in chosen:
            raise ValueError(f"{scenario.name} is given twice; allowed: scenarios with different names")
        refuse_unlike(f"{run.path} and the scenario {scenario.name}", run.game, scenario.game)
        chosen[scenario.name] = scenario
    return list(chosen.values())


def _background_agent(
    spec: Scripted | Frozen,
    background_runs: Mapping[str, LoadedRun],
    focal_run: LoadedRun,
    replicas: Sequence[int],
) -> AgentOfReplica:
    """Return the background agent that a specification describes.

    Args:
        background_runs: the runs of frozen agents, by their paths.
        focal_run: the run of the focal agents.
        replicas: the replicas of the focal run that play.

    Raises:
        ValueError: if a frozen agent would meet an agent of the same replica and seed.
    """
    if isinstance(spec, Scripted):
        return scripted_agent(spec.policy)
    background_run = background_runs[spec.run]
    if spec.replica is not None:
        return frozen_agent(background_run, spec)
    stored_replicas = {replica: _next_replica(background_run, replica) for replica in replicas}
    has_same_seed = background_run.experiment.seed == focal_run.experiment.seed
    if has_same_seed and any(replica == stored for replica, stored in stored_replicas.items()):
        raise ValueError(
            f"the background {background_run.path} keeps the single replica {background_run.replicas[0]} of "
            f"the same seed as {focal_run.path}; allowed: a run of at least 2 replicas, one of another seed, "
            "or a Frozen with the number of its replica"
        )
    return agents_of(background_run, stored_replicas)[spec.agent]


def _next_replica(run: LoadedRun, replica: int) -> int:
    """Return the replica of a run after this one; after the last replica the first."""
    replicas = run.replicas  # not always 0, 1, 2 and so on: a user may have kept only some
    index = replicas.index(replica) if replica in replicas else replica
    return replicas[(index + 1) % len(replicas)]


_METRICS_ON_PAGE: Final = (COLLECTIVE_RETURN, EQUALITY, "sustainability", "survival_steps", "peacefulness")
"""The social metrics that are printed; the table has more."""


def scenario_advantages(
    table: pa.Table, numbers: Sequence[str] = (FOCAL_RETURN, BACKGROUND_RETURN)
) -> Family:
    """Return how much more agents get with the run's agents in the focal places than with scripted agents.

    "focal/return" compares the agents in the focal places, and "background/return" the background agents.
    Differences are paired by replica, because all play the same worlds.

    Returns:
        The differences, by "scenario" and "focal", the scripted agents of the comparison.
    """
    disadvantages = differences(table, numbers, BY, {FOCAL: RUN_AGENTS})
    return disadvantages.changed(lambda _, difference: -difference)


def scenario_tables(table: pa.Table) -> Iterator[TextTable]:
    """Yield a table of returns with a row for each scenario, and a table of social metrics."""
    levels = estimates(table, [FOCAL_RETURN, BACKGROUND_RETURN], BY)
    advantages = scenario_advantages(table, [FOCAL_RETURN])
    scripted = FOCAL_AGENTS[1:]
    rows: list[list[TableCell]] = []
    for name in dict.fromkeys(scenario for scenario, _ in levels.labels):
        returns = [levels[name, focal, FOCAL_RETURN] for focal in FOCAL_AGENTS]
        changes = [Change(advantages[name, policy, FOCAL_RETURN]) for policy in scripted]
        rows.append([name, *returns, *changes, levels[name, RUN_AGENTS, BACKGROUND_RETURN]])
    columns = ["scenario", "focal: the run's agents", *(f"{policy} in their place" for policy in scripted)]
    columns += [*(f"run's - {policy}'s, paired" for policy in scripted), "background"]
    missing = table_note(table, "scenarios_left_out")
    note = advantages.note("of this table") + f"\nLeft out: {missing}" * bool(missing)
    yield TextTable("return per agent, apples", columns, rows, note)
    social = estimates(where(table, focal=RUN_AGENTS), _METRICS_ON_PAGE, "scenario")
    yield row_table(social, "all agents together, with the run's agents in the focal places")


_LOOKS: Final = {
    (RUN_AGENTS, FOCAL_RETURN): ("o", style.MEAN_COLOUR, "focal agents: the run's"),
    ("greedy", FOCAL_RETURN): ("s", style.MARK_COLOUR, "greedy in their place"),
    ("random", FOCAL_RETURN): ("D", "#8a8a8a", "random in their place"),
    (RUN_AGENTS, BACKGROUND_RETURN): ("|", "#000000", "background agents, beside the run's"),
}
"""The marker, the colour and the name of each result: the agents in the focal places, and whose return."""
_ROW_EM: Final = 4.4
"""The height of a scenario's row, in em."""
_RESULT_SPACING: Final = 0.16
"""The distance between two results of a scenario, as a share of a row."""


def draw_scenarios(table: pa.Table, path: Path | str, *, width: style.Width = "page") -> Path:
    """Draw the mean returns per agent with their intervals by Student's t, in one row for each scenario.

    A row shows the run's agents, greedy agents and random agents in the focal places, and the background.
    """
    levels = estimates(table, [FOCAL_RETURN, BACKGROUND_RETURN], BY)
    names = list(dict.fromkeys(scenario for scenario, _ in levels.labels))
    rows = np.arange(len(names))
    with style.drawing(path, width=width) as sheet:
        (axes,) = sheet.panels(1, row_height_em=_ROW_EM * len(rows) + 4)
        for index, ((focal, metric), (marker, colour, label)) in enumerate(_LOOKS.items()):
            means = [levels[name, focal, metric] for name in names]
            positions = list(rows + _RESULT_SPACING * (index - (len(_LOOKS) - 1) / 2))
            draw_dots(axes, positions, means, across=True, color=colour, marker=marker, label=label)
        for row in rows[1:]:
            axes.axhline(row - 0.5, color="#dddddd", linewidth=0.8)
        axes.set_yticks(rows, [style.wrapped(name.replace("_", " "), 0.3 * sheet.width_em) for name in names])
        axes.set(ylim=(len(rows) - 0.5, -0.5), xlabel="return per agent, apples")
        sheet.title = f"{table_note(table, 'run')}: returns by scenario"
        sheet.caption = (
            f"{table_note(table, 'fresh')} in each placement, the same worlds for all; {OVER_REPLICAS}."
        )
    return Path(path)
