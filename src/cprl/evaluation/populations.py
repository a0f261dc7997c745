"""play_population: scripted and stored agents in any mix, in fresh worlds; and what a word names."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from torchrl.envs import EnvBase

from cprl.commons import maps
from cprl.commons.game import Game
from cprl.commons.published import Variant, check_board
from cprl.commons.rules import Rules
from cprl.commons.spaces import Spaces
from cprl.envs.make_env import is_playable, make_env, spaces_of
from cprl.evaluation.evaluate import SEED, check
from cprl.evaluation.lanes import Place, Played
from cprl.experiment import presets
from cprl.measuring.evaluate import evaluate
from cprl.policies.scripted import SCRIPTED_POLICIES
from cprl.population import AgentSpec, Frozen, Scripted, specs_by_agent
from cprl.training.agents import LoadedRun, Population, load
from cprl.values import Positive, checked, made, refusal, trust

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

    Returns:
        Episodes by the index of the replica, 0 to R - 1.
    """
    trust(*allow)
    place = place_of(where)
    specs = specs_by_agent(agents, place.game.agents)
    for agent, spec in enumerate(specs):
        if not isinstance(spec, Scripted | Frozen):
            raise ValueError(f"agents[{agent}] is a {type(spec).__name__}; allowed: {_SPECS}")
    replicas = checked("replicas", replicas, Positive)
    runs = {spec.run for spec in specs if isinstance(spec, Frozen)}
    check(episodes=episodes, seed=seed, runs=list(map(load, sorted(runs))))
    population = Population(place.env(replicas, seed=seed), specs, seed=seed)
    env = place.env(replicas * episodes, seed=seed)
    ended = evaluate(env, population.policy(episodes), explore=not greedy)
    return {replica: ended[replica * episodes :][:episodes] for replica in range(replicas)}


def place_of(where: Any) -> Place:
    """A run as it is, a game as what makes fresh worlds of it."""
    if isinstance(where, LoadedRun):
        return where
    if not is_playable(where):
        raise refusal("where", where, "a game such as cprl.Game, or a value of cprl.load")
    return _FreshGame(made(where))


@dataclass(frozen=True)
class _FreshGame:
    game: Any

    @property
    def playing(self) -> Game | Spaces:
        return self.game if isinstance(self.game, Game) else spaces_of(self.env())

    def env(self, worlds: int = 1, *, seed: int = 0, first_world: int = 0) -> EnvBase:
        return make_env(self.game, worlds=worlds, seed=seed, first_world=first_world)


_LONGEST_DRAWING_BYTES: Final = 10_000_000


def board_named(
    board: str, variant: Variant = "published", *, allow: Sequence[str] = ()
) -> tuple[Game, LoadedRun | None]:
    """A game, and the run that has it.

    Args:
        board: the name of a published board, the directory of a run, whose game it is then, or a file with a
            drawing, see `cprl.maps.parse`, played by the published rules.
    """
    checked("variant", variant, Variant)
    check_board(board)
    if board in presets.BOARDS:
        return presets.game(board, variant=variant), None
    path = Path(board)
    if variant != "published":
        raise ValueError(
            f'variant is "{variant}"; allowed with {board}: "published", since it names no preset'
        )
    if path.is_dir():
        run = load(path, allow=allow)
        if not isinstance(run.game, Game):
            raise ValueError(f"{board} plays a game without a board of cprl; allowed: a run of a cprl.Game")
        return run.game, run
    if path.stat().st_size > _LONGEST_DRAWING_BYTES:
        raise ValueError(f"{path} has more than {_LONGEST_DRAWING_BYTES:,} bytes; allowed: a drawing")
    try:
        return Game(map=maps.parse(path.read_text(encoding="utf-8")), rules=Rules()), None
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def agent_named(who: str, agent: int, *, replica: int | None, name: str = "others") -> AgentSpec:
    """Who plays at an index: a scripted policy, or the agent of a run with that index."""
    if who in SCRIPTED_POLICIES:
        return Scripted(who)
    if not Path(who).is_dir():
        names = ", ".join(SCRIPTED_POLICIES)
        raise ValueError(f"{name} is {who!r}; allowed: {names}, or a run's directory")
    return Frozen(str(who), agent, replica)
