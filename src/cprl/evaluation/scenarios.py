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
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeAlias, get_args

import numpy as np
import pyarrow as pa

from cprl.commons.game import Game
from cprl.evaluation.evaluate import SEED, bars_of, heading, opened, refuse_other_games, refuse_unlike
from cprl.evaluation.lanes import (
    Agent,
    Part,
    Results,
    Who,
    Whose,
    agents_of,
    fresh_of,
    frozen,
    more,
    scripted,
)
from cprl.experiment import presets
from cprl.measuring.played import Measured, notes_on
from cprl.measuring.registry import with_unit
from cprl.measuring.statistics import HOLM, Estimate, estimate, starred
from cprl.population import Frozen, Scripted
from cprl.system.working import say_how_far, working
from cprl.terminal import style
from cprl.terminal.tables import Cells
from cprl.training.agents import LoadedRun, check_scripted, load
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
    """The folder with the results that come with a checkout of cprl, which is `docs/results`; an installed
    wheel has none."""
    return Path(__file__).parents[3] / "docs" / "results"


def stored_for(game: Game) -> Path | None:
    """The folder of the committed population that was trained on a game, whether it is at hand or not; None
    if there is none."""
    for board, variant, may_fire, name in _COMMITTED:
        published = presets.game(board, variant=variant)
        if game == replace(published, rules=replace(published.rules, may_fire=may_fire)):
            return results_folder() / name
    return None


def left_out_of(game: Game) -> str:
    """Which scenarios of a game are not at hand and why; "" if all are."""
    folder = stored_for(game)
    if folder is None or folder.is_dir():
        return ""
    names = " and ".join(f"{focal}_among_{STORED}" for focal in _modes(game))
    return f"{names}: the stored population {folder} comes with a checkout of cprl, and is not there"


def scenarios_of(game: Game) -> tuple[Scenario, ...]:
    """All named scenarios of a game: as a majority and as a minority among each of `SCRIPTED`, and among the
    committed population that DQN trained on this very game, if there is one and its folder is at hand.

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


FocalAgents: TypeAlias = Literal["run", "random", "greedy"]
"""Who takes the focal places: the run's agents, or agents that follow a scripted policy."""
FOCAL_AGENTS: Final[tuple[FocalAgents, ...]] = get_args(FocalAgents)


class Score(Results):
    """The episodes of one scenario."""

    def measures(self, focal: FocalAgents = "run") -> dict[str, Measured]:
        """focal/return and background/return, the mean return of a focal and of a background agent, then the
        social metrics of all agents together, and those of institutions as `institutions/fines` and so on;
        intervals by Student's t."""
        return self.where(focal=focal).estimates("focal", "background")

    def advantage(self, over: FocalAgents, *, whose: Whose = "focal") -> Estimate:
        """What the run's agents get more than others would in their places; or what the background gets
        more among them. Paired by replica, which plays the same worlds; the interval is by Student's t."""
        return more(self.where(focal="run"), self.where(focal=over), whose)


@dataclass(frozen=True, kw_only=True, eq=False)
class Scores(Results):
    """What a run reached, by "scenario", "focal", who takes the focal places, and "focal_agents", their
    indices, e.g. "0 2 3"."""

    run: LoadedRun

    @property
    def by_scenario(self) -> dict[str, Score]:
        """The scores by the name of the scenario."""
        names = dict.fromkeys(str(part.labels["scenario"]) for part in self.parts)
        return {name: Score(parts=self.where(scenario=name).parts, fresh=self.fresh) for name in names}


@working("playing scenarios")
def run_scenarios(
    run: str | Path | LoadedRun,
    *,
    scenarios: Sequence[str | Scenario] = (),
    episodes: int = 5,
    greedy: bool = False,
    seed: int = SEED,
    replicas: Sequence[int] = (),
) -> Scores:
    """Plays scenarios with the agents of a stored run in the focal places, and with random and with greedy
    agents in these places, in the same worlds.

    Args:
        scenarios: names of `scenarios_of` the run's game, or scenarios of your own on the same game; by
            default all that it has.
        greedy: whether stored agents take their best action, see `cprl.evaluate_run`.
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
    fresh = fresh_of(
        [loaded], episodes=episodes, greedy=greedy, seed=seed, replicas=replicas, among=stored.values()
    )
    _refuse_meeting_itself(loaded, chosen, stored, fresh.replicas)
    focal_agents: dict[FocalAgents, Sequence[Agent]] = {
        "run": agents_of(loaded),
        "random": [scripted("random")] * len(everyone),
        "greedy": [scripted("greedy")] * len(everyone),
    }
    parts: list[Part] = []
    for scenario in chosen:
        background = [_background(spec, stored) for spec in scenario.background]
        for who, focal in focal_agents.items():
            for places in scenario.placements:
                agents = [focal[agent] if agent in places else background[agent] for agent in everyone]
                indices = " ".join(map(str, places))
                say_how_far(len(parts), None, "populations")
                labels = {"scenario": scenario.name, "focal": who, "focal_agents": indices}
                parts.append(Part(labels, fresh.play(loaded, agents), (places,)))
    return Scores(run=loaded, parts=parts, fresh=fresh)


def _chosen(run: LoadedRun, scenarios: Sequence[str | Scenario]) -> list[Scenario]:
    """The scenarios by their names or as they are, checked against the run's game."""
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


def _background(spec: Scripted | Frozen, stored: Mapping[str, LoadedRun]) -> Agent:
    if isinstance(spec, Scripted):
        return scripted(spec.policy)
    run = stored[spec.run]
    if spec.replica is not None:
        return frozen(run, spec)
    return lambda replica: run.agent(spec.agent, replica=_following(run, replica))


def _following(run: LoadedRun, replica: int) -> int:
    """The number of the replica of a background that plays beside this one: of those that it keeps the next,
    the first after the last."""
    numbers = run.replicas  # some may be missing
    before = numbers.index(replica) if replica in numbers else replica
    return numbers[(before + 1) % len(numbers)]


def _refuse_meeting_itself(
    run: LoadedRun, scenarios: Sequence[Scenario], stored: Mapping[str, LoadedRun], replicas: Sequence[int]
) -> None:
    """Raises a ValueError for a background that has no other replica than one that it would play beside."""
    for scenario in scenarios:
        of_any = {
            spec.run for spec in scenario.background if isinstance(spec, Frozen) and spec.replica is None
        }
        for background in map(stored.__getitem__, of_any):
            is_alike = background.experiment.seed == run.experiment.seed
            if is_alike and len(background.replicas) == 1 and background.replicas[0] in replicas:
                raise ValueError(
                    f"the scenario {scenario.name} has the background {background.path}, which keeps the "
                    f"single replica {background.replicas[0]} of the same seed; allowed: a run of at least 2 "
                    "replicas, one of another seed, or a Frozen with the number of its replica"
                )


SOCIAL: Final = ("collective_return", "equality", "sustainability", "survival_steps", "peacefulness")
"""The social metrics of the table in the terminal; the others are in `estimates`."""


def scenario_heading(scores: Scores) -> str:
    return heading(f"Scenarios of {scores.run.path.name}", scores.fresh, [scores.run], " in each placement")


def scenario_tables(scores: Scores) -> Iterator[Cells]:
    """A table of returns, a row for each scenario, and one of social metrics of all agents together."""
    columns = ["scenario", "focal: the run's agents", "random in their place", "greedy in their place"]
    columns += ["run's - random's, paired", "run's - greedy's, paired", "background"]
    by_scenario = scores.by_scenario
    ahead = [score.advantage(who) for score in by_scenario.values() for who in ("random", "greedy")]
    texts = iter(starred(ahead))
    rows = []
    for name, score in by_scenario.items():
        focal = [str(score.measures(who)["focal/return"]) for who in FOCAL_AGENTS]
        rows.append((name, *focal, next(texts), next(texts), str(score.measures()["background/return"])))
    everything = {scenario.name for scenario in scenarios_of(scores.run.game)}
    left_out = left_out_of(scores.run.game) if everything == set(by_scenario) else ""
    note = f"{HOLM} for all {len(ahead)} differences" + f". Left out: {left_out}" * bool(left_out)
    yield Cells("return per agent, apples", columns, rows, note)
    title = "all agents together, with the run's agents in the focal places"
    measured = {name: score.measures() for name, score in by_scenario.items()}
    social = [(name, *(str(measures[metric]) for metric in SOCIAL)) for name, measures in measured.items()]
    note = "\n".join(notes_on([measures[metric] for measures in measured.values() for metric in SOCIAL]))
    yield Cells(title, ["scenario", *map(with_unit, SOCIAL)], social, note)


def estimates(scores: Scores) -> pa.Table:
    """Every measure of every scenario as a row: "scenario", "focal" (who takes the focal places), "metric",
    "value", "low" and "high" (null where undefined), and how many "replicas", "episodes" and "undefined"
    episodes there were. Metrics "focal/advantage" and "background/advantage" of "random" and "greedy" are
    what the run's agents, or the background among them, get more; see `Score.advantage`."""
    rows: list[dict[str, Any]] = []
    for scenario, score in scores.by_scenario.items():
        for who in FOCAL_AGENTS:
            measures = score.measures(who)
            for whose in ("focal", "background") if who != "run" else ():
                ahead = score.advantage(who, whose=whose)
                measures[f"{whose}/advantage"] = replace(
                    measures["focal/return"], estimate=ahead, undefined=0
                )
            for metric, measured in measures.items():
                numbers = {name: getattr(measured.estimate, name, None) for name in ("value", "low", "high")}
                replicas = getattr(measured.estimate, "replicas", 0)
                counts = {"episodes": measured.episodes, "undefined": measured.undefined}
                labels = {"scenario": scenario, "focal": who, "metric": metric}
                rows.append({**labels, **numbers, "replicas": replicas, **counts})
    return pa.table({name: pa.array([row[name] for row in rows], from_pandas=True) for name in rows[0]})


_LOOKS: Final[dict[tuple[FocalAgents, Whose], tuple[str, str, str]]] = {
    ("run", "focal"): ("o", style.MEAN, "focal agents: the run's"),
    ("greedy", "focal"): ("s", style.MARK, "greedy in their place"),
    ("random", "focal"): ("D", "#8a8a8a", "random in their place"),
    ("run", "background"): ("|", "#000000", "background agents, beside the run's"),
}
"""Marker, colour and name of each number."""
_ROW: Final = 4.4
"""The height of a scenario in em."""
_BAND: Final = 0.16
"""The distance between two numbers of a scenario, in rows."""


def draw_scenarios(scores: Scores, path: Path | str, *, width: style.Width = "page") -> Path:
    """Draws the mean return per agent, a row for each scenario: of the run's agents in the focal places, of
    greedy and of random ones there, and of the background; intervals by Student's t."""
    by_scenario = scores.by_scenario
    rows = np.arange(len(by_scenario))
    with style.drawing(path, width=width) as sheet:
        (axes,) = sheet.panels(1, high=_ROW * len(rows) + 4)
        for place, ((who, whose), (marker, colour, label)) in enumerate(_LOOKS.items()):
            returns = [score.where(focal=who).mean_returns(whose) for score in by_scenario.values()]
            means, reach = bars_of(map(estimate, returns))
            at = rows + _BAND * (place - (len(_LOOKS) - 1) / 2)
            axes.errorbar(means, at, xerr=reach, fmt=marker, color=colour, markersize=6, label=label)
        for row in rows[1:]:
            axes.axhline(row - 0.5, color="#dddddd", linewidth=0.8)
        names = [style.wrapped(name.replace("_", " "), 0.3 * sheet.width_em) for name in by_scenario]
        axes.set_yticks(rows, names)
        axes.set(ylim=(len(rows) - 0.5, -0.5), xlabel="return per agent, apples")
        sheet.title = f"{scores.run.path.name}: returns by scenario"
        sheet.caption = (
            f"{scores.fresh} in each placement, the same worlds for all; mean over replicas, 95 % interval "
            "by Student's t."
        )
    return Path(path)
