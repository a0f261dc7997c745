"""play_population: agents that do not learn, scripted and stored ones in any mix, in fresh worlds."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from torchrl.envs import EnvBase

from cprl import arguments
from cprl.agents import Population
from cprl.custom import made
from cprl.envs.make_env import make_env
from cprl.evaluation.evaluate import SEED, check
from cprl.evaluation.lanes import Place, Played, play
from cprl.games import is_playable
from cprl.population import AgentSpec, Frozen, Scripted, specs_by_agent
from cprl.stored import LoadedRun, load

_SPECS: Final = "Scripted(policy) or Frozen(run, agent, replica)"


def play_population(
    where: Any,
    agents: Sequence[AgentSpec],
    *,
    episodes: int = 20,
    replicas: int = 8,
    greedy: bool = False,
    seed: int = SEED,
    allow: Sequence[str] = (),
) -> Played:
    """Plays fresh episodes of a population that does not learn.

    Args:
        where: a game, or a run, a value of `cprl.load`, whose game and transforms are used.
        agents: the specification of each agent, `Scripted` or `Frozen`. `Frozen(run, agent, replica=None)`
            plays in replica r what the run's replica r learned.
        episodes: episodes of each replica, each in its own world.
        replicas: the number R of replicas; where all agents are scripted, of independent groups of episodes.
        greedy: whether stored agents take their best action; else they explore as in evaluation.
        seed: the seed of the worlds and of all random numbers; with one seed all populations play in the
            same worlds.
        allow: what stored runs may import, see `cprl.load`.

    Returns:
        Episodes by the index of the replica, 0 to R - 1.

    Raises:
        ValueError: for agents that learn or do not fit the game, for the training seed of a stored agent, and
            for numbers out of range.
    """
    place = place_of(where)
    specs = specs_by_agent(arguments.objects("agents", agents, AgentSpec, _SPECS), place.game.agents)
    for agent, spec in enumerate(specs):
        if not isinstance(spec, Scripted | Frozen):
            raise ValueError(f"agents[{agent}] is a {type(spec).__name__}; allowed: {_SPECS}")
    replicas = arguments.integer("replicas", replicas, 1)
    runs = {spec.run for spec in specs if isinstance(spec, Frozen)}
    check(episodes=episodes, seed=seed, greedy=greedy, runs=[load(run, allow=allow) for run in sorted(runs)])
    population = Population(place.env(replicas, seed=seed), specs, seed=seed, allow=allow)
    policies = population.policy(episodes)
    return play(place, lambda _: policies, range(replicas), episodes=episodes, seed=seed, explore=not greedy)


def place_of(where: Any) -> Place:
    """A run as it is, a game as what makes fresh worlds of it.

    Raises:
        ValueError: if it is neither.
    """
    if isinstance(where, LoadedRun):
        return where
    if not is_playable(where):
        raise arguments.refusal("where", where, "a game such as cprl.Game, or a value of cprl.load")
    return _FreshGame(made(where))


@dataclass(frozen=True)
class _FreshGame:
    game: Any

    def env(self, worlds: int = 1, *, seed: int = 0, first_world: int = 0) -> EnvBase:
        """So many fresh worlds."""
        return make_env(self.game, worlds=worlds, seed=seed, first_world=first_world)
