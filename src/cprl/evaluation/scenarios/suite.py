"""run_scenarios: a stored run in scenarios, beside random and greedy agents in its place.

The focal agents are those of the run, each with its own index, so that everybody starts where it was trained
to. Every placement of a scenario is played by every replica, in the same worlds for the run's agents and for
those that it is held against; a number is a replica's mean over episodes and placements, estimated over
replicas, because only replicas are independent.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

from cprl import arguments
from cprl.agents import check_scripted
from cprl.evaluation.evaluate import SEED, check, chosen_replicas, opened
from cprl.evaluation.lanes import Played, play
from cprl.evaluation.same_game import differences, transform_differences
from cprl.evaluation.scenarios.backgrounds import check_game, left_out_of, scenarios_of
from cprl.evaluation.scenarios.scenario import Scenario
from cprl.evaluation.scenarios.score import FOCAL_AGENTS, FocalAgents, Score, Scores
from cprl.policies.assignment import AgentPolicies
from cprl.population import Frozen, Scripted
from cprl.stored import LoadedRun, load
from cprl.stored_agents import StoredAgent, stored_policies

Member: TypeAlias = Callable[[int], StoredAgent]
"""Who plays with an agent index, by the index of the replica."""


def run_scenarios(
    run: str | Path | LoadedRun,
    *,
    scenarios: Sequence[str | Scenario] = (),
    episodes: int = 5,
    greedy: bool = False,
    seed: int = SEED,
    replicas: Sequence[int] = (),
    allow: Sequence[str] = (),
) -> Scores:
    """Plays scenarios with the agents of a stored run in the focal places, and with random and with greedy
    agents in these places, in the same worlds.

    Args:
        run: its directory, its exported results, or a value of `cprl.load`.
        scenarios: names of `scenarios_of` the run's game, or scenarios of your own on the same game; by
            default all that it has.
        episodes: episodes of each replica in each placement, each in its own world.
        greedy: whether stored agents take their best action, see `cprl.evaluate_run`.
        seed: the seed of the worlds and of all random numbers; equal seeds give equal episodes.
        replicas: the indices of the replicas that play; by default all.
        allow: see `cprl.load`; for stored backgrounds too.

    Raises:
        ValueError: for a game that has no scenarios, see `scenarios_of`; for a scenario that is unknown,
            given twice, or of another game (names the differences); if the seed trained an agent; and see
            `cprl.evaluate_run`.
    """
    loaded = opened(run, allow)
    check_game(loaded.game)
    everyone = tuple(range(loaded.game.agents))
    check_scripted([(Scripted("greedy"), everyone)], loaded.spaces, loaded.game)
    chosen = _chosen(loaded, scenarios)
    stored = _stored(loaded, chosen, allow)
    check(episodes=episodes, seed=seed, greedy=greedy, runs=[loaded, *stored.values()])
    numbers = chosen_replicas({str(loaded.path): loaded}, replicas)
    _refuse_meeting_itself(loaded, chosen, stored, numbers)

    def played(members: Sequence[Member]) -> Played:
        who = partial(_policies, loaded.game, members, worlds=episodes, seed=seed)
        return play(loaded, who, numbers, episodes=episodes, seed=seed, explore=not greedy)

    scores = {}
    for scenario in chosen:
        background = [_background(spec, stored) for spec in scenario.background]
        scores[scenario.name] = Score(
            scenario=scenario,
            played={
                focal: {
                    places: played(
                        [
                            _focal(loaded, focal, agent) if agent in places else background[agent]
                            for agent in everyone
                        ]
                    )
                    for places in scenario.placements
                }
                for focal in FOCAL_AGENTS
            },
        )
    return Scores(
        run=loaded,
        by_scenario=scores,
        replicas=numbers,
        episodes=episodes,
        seed=seed,
        greedy=greedy,
        left_out="" if scenarios else left_out_of(loaded.game),
    )


def _chosen(run: LoadedRun, scenarios: Sequence[str | Scenario]) -> list[Scenario]:
    """The scenarios by their names or as they are, checked against the run's game."""
    named = {scenario.name: scenario for scenario in scenarios_of(run.game)}
    found: dict[str, Scenario] = {}
    for given in arguments.listed("scenarios", scenarios, "names of scenarios, or values of Scenario"):
        arguments.object_of("a scenario", given, (str, Scenario), "its name, or a value of Scenario")
        if isinstance(given, str) and given not in named:
            why = left_out_of(run.game)
            raise ValueError(
                f"a scenario is {given!r}; allowed for this game: {', '.join(named)}"
                + (f"; not at hand are {why}" if why else "")
            )
        scenario = named[given] if isinstance(given, str) else given
        if scenario.name in found:
            raise ValueError(f"{scenario.name} is given twice; allowed: scenarios with different names")
        _check_game_of(f"the scenario {scenario.name}", differences(run.game, scenario.game), run)
        found[scenario.name] = scenario
    return list((found or named).values())


def _stored(run: LoadedRun, scenarios: Sequence[Scenario], allow: Sequence[str]) -> dict[str, LoadedRun]:
    """The runs of the stored background agents by their paths."""
    specs = (spec for scenario in scenarios for spec in scenario.background)
    paths = dict.fromkeys(spec.run for spec in specs if isinstance(spec, Frozen))
    runs = {path: load(path, allow=allow) for path in paths}
    for path, stored in runs.items():
        found = differences(run.game, stored.game) + transform_differences(run, stored)
        _check_game_of(f"the background {path}", found, run)
    return runs


def _check_game_of(what: str, found: Sequence[str], run: LoadedRun) -> None:
    if found:
        raise ValueError(
            f"{run.path} and {what} have different games: {'; '.join(found)}; allowed: the same game"
        )


def _focal(run: LoadedRun, focal: FocalAgents, agent: int) -> Member:
    """The agent in a focal place."""
    if focal == "run":
        return lambda replica: run.agent(agent, replica=replica)
    return lambda _: StoredAgent(("scripted", focal))


def _background(spec: Scripted | Frozen, stored: Mapping[str, LoadedRun]) -> Member:
    """The agent in a background place; see `Scenario.background`."""
    if isinstance(spec, Scripted):
        return lambda _: StoredAgent(("scripted", spec.policy))
    run = stored[spec.run]

    def theirs(replica: int) -> StoredAgent:
        number = _following(run, replica) if spec.replica is None else spec.replica_for(replica)
        return run.agent(spec.agent, replica=number)

    return theirs


def _following(run: LoadedRun, replica: int) -> int:
    """The number of the replica of a background that plays beside this one: of those that it keeps the next,
    the first after the last."""
    kept = run.replicas  # some may be missing
    before = kept.index(replica) if replica in kept else replica
    return kept[(before + 1) % len(kept)]


def _refuse_meeting_itself(
    run: LoadedRun, scenarios: Sequence[Scenario], stored: Mapping[str, LoadedRun], replicas: Sequence[int]
) -> None:
    """Raises a ValueError for a background that has no other replica than one that it would play beside."""
    for scenario in scenarios:
        for spec in scenario.background:
            if not isinstance(spec, Frozen) or spec.replica is not None:
                continue
            own = stored[spec.run]
            if (
                own.experiment.seed == run.experiment.seed
                and len(own.replicas) == 1
                and own.replicas[0] in replicas
            ):
                raise ValueError(
                    f"the scenario {scenario.name} has the background {own.path}, which keeps the single "
                    f"replica {own.replicas[0]}, so that agents trained together or from the same seed, "
                    f"{run.experiment.seed}, would meet; allowed: a run of at least 2 replicas, one of "
                    "another seed, or a Frozen with the number of its replica"
                )


def _policies(
    game: Any, members: Sequence[Member], replicas: Sequence[int], *, worlds: int, seed: int
) -> AgentPolicies:
    """The policies of all agents of these replicas."""
    found = [[member(replica) for replica in replicas] for member in members]
    return stored_policies(found, game, replicas=replicas, worlds=worlds, seed=seed)
