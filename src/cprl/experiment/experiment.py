"""Experiment: everything that decides a training, as a value that a run's recipe holds."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from cprl.algorithms import Tabular
from cprl.algorithms.base import TeamAlgorithm
from cprl.commons.game import Game
from cprl.envs.make_env import PlayableGame, game_of, stored_game
from cprl.experiment.engine import Engine, engine_of
from cprl.measuring.episodes import check_own_metrics
from cprl.objectives.rewards import check_reward
from cprl.pictures.readable import game_html
from cprl.population import (
    AgentSpec,
    Frozen,
    Learning,
    Team,
    learned,
    refuse_undecided,
    specs_by_agent,
    stored_of,
)
from cprl.runs.files import RECIPE_FORMAT, written_by_another
from cprl.runs.length import Length
from cprl.runs.recipe import recipe_config, rules_of_own, with_runs_moved
from cprl.runs.schedule import OnNan, Schedule
from cprl.system.memory import Device
from cprl.values import (
    MOST_INT64,
    Custom,
    DirectoryName,
    Positive,
    Range,
    Value,
    build,
    checked,
    custom_targets,
    described,
    differences,
    hints_of,
    refusal,
    shown,
    to_config,
)

LoggerName = Literal["tensorboard", "wandb"]
MOST_SEED: Final = 2**64 - 2
"""Evaluation plays worlds of the next seed."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Experiment(Value, stored=False, called="experiment"):
    """What is trained and how; equals what `recipe.json` holds.

    Lists become tuples, though type checkers ask for tuples. Two are equal where their recipes are, of
    which "auto" says the engine that it stands for.
    """

    name: DirectoryName
    """What it is called: of the recipe, and of the run's directory."""
    game: Game | Custom | PlayableGame
    """What is played."""
    agents: tuple[AgentSpec, ...]
    """How each agent is specified; see `cprl.population`."""
    episodes: Positive | None = None
    """Episodes that each replica trains, in all its worlds together; or say `steps`."""
    steps: Annotated[int, Range(1, MOST_INT64)] | None = None
    """Steps that each replica trains, a turn of W worlds being W; or say `episodes`."""
    replicas: Annotated[int, Range(1, 2**20)] = 1
    """Independent repetitions R of the whole training, side by side."""
    worlds: Annotated[int, Range(1, 2**20)] = 1
    """Worlds W in which each replica plays at once, and from all of which its agents learn."""
    seed: Annotated[int, Range(0, MOST_SEED)] = 0
    """Of chance, weights, exploration and replay."""
    evaluation_episodes: Annotated[int, Range(1, 2**20)] = 20
    """Fresh episodes of each replica after training, and of the random policy."""
    evaluate_every: Positive | None = None
    """Episodes after which agents play as many fresh episodes greedily, again and again; None for never."""
    update_every: Positive = 1
    """Environment steps k after which agents learn, then k times."""
    transforms: tuple[Custom, ...] = ()
    """TorchRL transforms of the environment, the first one nearest to it."""
    callbacks: tuple[Custom, ...] = ()
    """Callbacks of the training; see `cprl.training`."""
    metrics: tuple[Custom, ...] = ()
    """Metrics of your own: functions of an episode that return a number; see docs/metrics.md."""
    loggers: tuple[LoggerName | Custom, ...] = ()
    """TorchRL's loggers that get every series: "tensorboard", "wandb", or one of your own."""
    device: Device = "cpu"
    """Where agents learn, e.g. "cpu" or "cuda:0"."""
    engine: Engine = "auto"
    """How updates are computed: "compiled" by torch, several times faster and in need of a C++ compiler;
    "eager", the same uncompiled; "auto", a short training "eager" and a long one "compiled", see
    `cprl.experiment.engine`; "torchrl", stock TorchRL, one agent after the other."""
    on_nan: OnNan = "stop"
    """What happens when a loss, weight, reward or observation is NaN or infinite: "stop" ends the training;
    "continue" warns, and the others train on."""

    def __repr__(self) -> str:
        return (
            f"Experiment({self.name!r}, {self.game!r}, {self.length}, {self.replicas} replicas, "
            f"seed={self.seed})"
        )

    def _repr_html_(self) -> str:
        who, game = "", f"<p>{escape(repr(self.game))}</p>"
        if isinstance(self.game, Game):
            who = f"{learned(specs_by_agent(self.agents, self.game.agents))}, "
            game = game_html(self.game, self.own_rules)
        code = f"<p>{escape(self.own_code)}</p>" if self.own_code else ""
        return f"<p><b>{escape(self.name)}</b>: {escape(who + self.trained_for)}.</p>{game}{code}"

    @property
    def own_rules(self) -> str:
        """The rules of the user's own in words, a transform or a game each; "" without any."""
        return rules_of_own(self.to_config())

    @property
    def own_code(self) -> str:
        """All that is of the user's own, by the field where it stands, in a sentence; "" without any."""
        parts = {name: described(part) for name, part in self.to_config().items()}
        said = "; ".join(f"{name}: {', '.join(words)}" for name, words in parts.items() if words)
        return f"Code of its own: {said}." if said else ""

    @property
    def title(self) -> str:
        """What a figure, a summary or a recording of it is called."""
        return f"{self.name}, {self.trained_in}, {self.length}"

    @property
    def trained_for(self) -> str:
        """How long it trains, in words."""
        return f"trained for {self.length} in {self.trained_in}"

    @property
    def trained_in(self) -> str:
        """Its replicas, and their worlds where they have several, in words."""
        worlds = f" of {self.worlds:,} worlds" if self.worlds > 1 else ""
        return f"{self.replicas} replica{'s' * (self.replicas > 1)}{worlds}"

    @property
    def length(self) -> Length:
        """How long each replica trains."""
        clock = getattr(getattr(self.game, "rules", None), "episode_steps", None)
        return Length.of(vars(self), clock)

    @property
    def schedule(self) -> Schedule:
        """How long each replica trains, in how many worlds, and when its agents learn."""
        return Schedule(**{name: getattr(self, name) for name in hints_of(Schedule)})

    def __post_init__(self) -> None:
        if isinstance(self.game, type):
            raise refusal("experiment.game", self.game, f"a game, such as {self.game.__name__}(...)")
        super().__post_init__()
        if isinstance(self.game, PlayableGame):
            checked("experiment.game.agents", self.game.agents, Positive)
        self.to_config()
        check_own_metrics(self.metrics)
        _check_numbers(self)
        _check_agents(self, self.schedule)
        _check_engine(self)

    def to_config(self) -> dict[str, Any]:
        values = {name: getattr(self, name) for name in hints_of(type(self))}
        values["game"] = stored_game(self.game)
        return {name: to_config(value, f"experiment.{name}") for name, value in values.items()}

    @classmethod
    def from_config(cls, table: Mapping[str, Any]) -> "Experiment":
        """Return the experiment that `to_config` gave; of the modules that it names a game's is imported."""
        read = build(cls, table, "experiment")
        return read if not isinstance(read.game, Custom) else replace(read, game=game_of(read.game))

    def to_recipe(self, directory: str | Path | None = None) -> dict[str, Any]:
        """Return what `recipe.json` says of it; `cprl.runs.recipe.start_run` adds when and by what.

        Args:
            directory: where the recipe is kept: runs of `Frozen` are then given relative to it.
        """
        table = self.to_config()
        table = table if directory is None else with_runs_moved(table, ".", directory)
        return {"format": RECIPE_FORMAT, "recipe": self.name, "experiment": table}

    @classmethod
    def from_recipe(cls, recipe: Mapping[str, Any], *, directory: str | Path | None = None) -> "Experiment":
        """Return the experiment of a recipe, as `recipe.json` holds it.

        Args:
            directory: where the recipe is kept; runs of `Frozen` are then relative to where we stand.
        """
        try:
            table = recipe_config(recipe)
            table = table if directory is None else with_runs_moved(table, directory, ".")
            return cls.from_config(table)
        except ValueError as error:
            raise ValueError(f"{error}{written_by_another(recipe)}") from error

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Experiment):
            return NotImplemented
        ours, theirs = ({**each.to_config(), "engine": engine_of(each)} for each in (self, other))
        return ours == theirs

    def __hash__(self) -> int:
        return hash((self.name, self.length, self.replicas, self.seed))


def changes(before: Experiment, now: Experiment) -> list[str]:
    return differences(before.to_config(), now.to_config(), "experiment", Experiment)


_MOST_WORLDS: Final = 2**22


def _check_numbers(experiment: Experiment) -> None:
    most = _MOST_WORLDS // experiment.replicas
    for name in ("worlds", "evaluation_episodes"):
        if getattr(experiment, name) > most:
            raise ValueError(
                f"experiment.{name} is {getattr(experiment, name)}; allowed for {experiment.replicas} "
                f"replicas: up to {most}, because all are played at once"
            )
    for target in custom_targets(experiment.to_config()):
        if target.startswith("__main__:"):
            raise ValueError(
                f"experiment has {target}, of the script that runs, which nothing else can import; allowed: "
                "the class or function itself, or a module of its own, and its name"
            )


def _check_agents(experiment: Experiment, schedule: Schedule) -> None:
    if not isinstance(experiment.game, Custom):
        try:
            specs_by_agent(experiment.agents, experiment.game.agents)
            refuse_undecided(experiment.agents, len(getattr(experiment.game, "ballots", ())))
        except ValueError as error:
            raise ValueError(f"experiment.agents: {error}") from error
    for place, spec in enumerate(experiment.agents):
        where = f"experiment.agents[{place}]"
        if (stored := stored_of(spec)) is not None:
            _check_stored(where if stored is spec else f"{where}.start_from", stored, experiment.replicas)
        if isinstance(spec, Learning | Team) and not isinstance(experiment.game, Custom):
            check_reward(f"{where}.reward", spec.reward, experiment.game.agents)
        if isinstance(spec, Team) and isinstance(spec.algorithm, TeamAlgorithm):
            spec.algorithm.check_team(len(spec.agents), spec.reward)
        settings: Any = getattr(getattr(spec, "algorithm", None), "settings", None)
        if hasattr(settings, "refuse_worlds"):
            try:
                settings.refuse_worlds(schedule.worlds)
            except ValueError as error:
                raise ValueError(f"{where}.algorithm.settings: {error}") from error
        rollout_steps = getattr(settings, "rollout_steps", schedule.update_every)
        schedule.refuse_rollouts(rollout_steps, f"{where}.algorithm.settings.rollout_steps")


def _check_stored(where: str, stored: Frozen, replicas: int) -> None:
    if Path(stored.run).is_absolute():
        raise ValueError(
            f"{where}.run is {stored.run}, an absolute path, which is another one on another machine; "
            "allowed: a path relative to where we stand"
        )
    if isinstance(stored.replica, tuple) and len(stored.replica) != replicas:
        raise ValueError(
            f"{where}.replica is {shown(stored.replica)}, of {len(stored.replica)} numbers; allowed: "
            f"{replicas} of them, one for each replica of the experiment; one number for all; or None"
        )


def _check_engine(experiment: Experiment) -> None:
    if experiment.engine != "torchrl":
        return
    for place, spec in enumerate(experiment.agents):
        if isinstance(spec, Team) or (isinstance(spec, Learning) and isinstance(spec.algorithm, Tabular)):
            what = "a Team" if isinstance(spec, Team) else "Tabular"
            raise ValueError(
                f'experiment.agents[{place}] is {what}, which engine="torchrl" cannot train; allowed: '
                '"auto", "compiled", "eager"'
            )
