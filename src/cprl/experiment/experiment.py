"""Experiment: all settings of a training, as a value that the recipe of a run holds."""

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
from cprl.measuring.tracker import check_custom_metrics
from cprl.objectives.rewards import check_reward
from cprl.pictures.readable import game_html
from cprl.policies.governors import ScriptedGovernor
from cprl.population import (
    AgentSpec,
    Frozen,
    GovernorSpec,
    Learning,
    Team,
    has_people,
    learned,
    refuse_undecided,
    specs_by_agent,
    stored_in,
)
from cprl.runs.files import RECIPE_FORMAT, written_by_another
from cprl.runs.length import Length
from cprl.runs.recipe import custom_rules_in, recipe_config, with_runs_moved
from cprl.runs.schedule import OnNan, Schedule
from cprl.system.memory import Device
from cprl.values import (
    MOST_INT64,
    Custom,
    DirectoryName,
    Natural,
    Positive,
    Range,
    Steps,
    Value,
    build,
    checked,
    custom_targets,
    describe_changes,
    describe_customs,
    hints_of,
    refusal,
    short_repr,
    to_config,
)

LoggerName = Literal["tensorboard", "wandb"]
MOST_SEED: Final = 2**64 - 2
"""Evaluation plays worlds of the next seed."""


@dataclass(frozen=True, kw_only=True)
class EarlierGame(Value):
    """A game that agents play before another one in the same training, see `Experiment.earlier`."""

    game: Game | Custom | PlayableGame
    """The game; it shows and asks the same of the same agents as the game at the end."""
    steps: Steps
    """Steps of each replica, W in each turn of W worlds; the turn that reaches them is the game's last."""

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "game", stored_game(self.game))


@dataclass(frozen=True, kw_only=True, eq=False)
class Experiment(Value, stored=False, called="experiment"):
    """A training as a value: the game, its agents, and how they are trained.

    `recipe.json` holds all of it. Lists become tuples, though type checkers ask for tuples. Two experiments
    are equal if their recipes are, with "auto" replaced by the engine that it stands for.
    """

    name: DirectoryName
    """The name of the recipe, and of the run's directory."""
    game: Game | Custom | PlayableGame
    """The game that is played: in training, after those of `earlier`, in evaluations and afterwards."""
    agents: tuple[AgentSpec, ...]
    """The specification of each agent; see `cprl.population`."""
    governor: GovernorSpec | None = None
    """How the game's `Governor` decides: `Learning` with an algorithm of one agent, whose settings count
    periods where they count steps; a `StockRule` or a `Constant`; or `Frozen`, which names it as the agent
    after the last of its run. None leaves the first option in force."""
    governor_from_step: Natural = 0
    """The steps of each replica before the governor may decide and learn, so that agents learn first. It
    begins with the next period that starts then; until that its first option is in force."""
    episodes: Positive | None = None
    """Episodes that each replica trains, in all its worlds together; None with `steps`."""
    steps: Annotated[int, Range(1, MOST_INT64)] | None = None
    """Steps that each replica trains, W in each turn of W worlds; None with `episodes`."""
    earlier: tuple[EarlierGame, ...] = ()
    """Games that agents play first in a training of `steps`, in this order. Where one ends, the running
    episodes are cut, as by a time limit, and not counted; what learns carries on."""
    replicas: Annotated[int, Range(1, 2**20)] = 1
    """Independent repetitions R of the whole training, side by side."""
    worlds: Annotated[int, Range(1, 2**20)] = 1
    """Worlds W in which each replica plays side by side, and from which its agents learn."""
    seed: Annotated[int, Range(0, MOST_SEED)] = 0
    """The seed of the game, initial weights, exploration and replay."""
    evaluation_episodes: Annotated[int, Range(1, 2**20)] = 20
    """Fresh episodes of each replica after training, and of the random policy."""
    evaluate_every: Positive | None = None
    """Episodes between greedy evaluations in fresh episodes during training; None for no evaluation."""
    update_every: Positive = 1
    """Turns k between updates; agents then update k times."""
    transforms: tuple[Custom, ...] = ()
    """TorchRL transforms of the environment, the first one nearest to it."""
    callbacks: tuple[Custom, ...] = ()
    """Callbacks of the training; see `cprl.training`."""
    metrics: tuple[Custom, ...] = ()
    """Custom metrics: functions of an episode that return a number; see docs/metrics.md."""
    loggers: tuple[LoggerName | Custom, ...] = ()
    """TorchRL's loggers that get every series: "tensorboard", "wandb", or one of your own."""
    device: Device = "cpu"
    """The device where agents learn, e.g. "cpu" or "cuda:0"."""
    engine: Engine = "auto"
    """The engine that computes updates: "compiled" by torch, several times faster, needs a C++ compiler;
    "eager" is the same uncompiled; "auto" takes "eager" for a short training and "compiled" for a long one,
    see `cprl.experiment.engine`; "torchrl" is stock TorchRL, one agent after the other."""
    on_nan: OnNan = "stop"
    """The reaction to a loss, weight, reward or observation that is NaN or infinite: "stop" ends the
    training; "continue" warns, and the other agents train on."""

    def __repr__(self) -> str:
        return (
            f"Experiment({self.name!r}, {self.game!r}, {self.length}, {self.replicas} replicas, "
            f"seed={self.seed})"
        )

    def _repr_html_(self) -> str:
        training = self.trained_for
        game = f"<p>{escape(repr(self.game))}</p>"
        if isinstance(self.game, Game):
            training = f"{learned(specs_by_agent(self.agents, self.game.agents))}, {training}"
            game = game_html(self.game, self.custom_rules)
        code = f"<p>{escape(self.custom_code)}</p>" if self.custom_code else ""
        return f"<p><b>{escape(self.name)}</b>: {escape(training)}.</p>{game}{code}"

    @property
    def custom_rules(self) -> str:
        """Return a description of custom rules, of a transform or a game; "" without any."""
        return custom_rules_in(self.to_config())

    @property
    def custom_code(self) -> str:
        """Return a sentence about all user code, by field; "" without any."""
        descriptions = []
        for name, part in self.to_config().items():
            customs = ", ".join(describe_customs(part))
            descriptions += [f"{name}: {customs}"] if customs else []
        return f"Code of its own: {'; '.join(descriptions)}." if descriptions else ""

    @property
    def title(self) -> str:
        """Return the title of its figures, summary and recording."""
        return f"{self.name}, {self.trained_in}, {self.length}{self._in_earlier_games}"

    @property
    def trained_for(self) -> str:
        """Return the length and the replicas in words."""
        verb = "played" if has_people(self.agents) else "trained"
        return f"{verb} for {self.length} in {self.trained_in}{self._in_earlier_games}"

    @property
    def trained_in(self) -> str:
        """Return the replicas, and their worlds if there are several, in words."""
        worlds = f" of {self.worlds:,} worlds" if self.worlds > 1 else ""
        noun = "group" if has_people(self.agents) else "replica"
        return f"{self.replicas} {noun}{'s' * (self.replicas > 1)}{worlds}"

    @property
    def _in_earlier_games(self) -> str:
        steps = sum(part.steps for part in self.earlier)
        return f", the first {steps:,} steps in other games" if steps else ""

    @property
    def length(self) -> Length:
        """Return the length of the training of each replica."""
        clock = getattr(getattr(self.game, "rules", None), "episode_steps", None)
        return Length.of(vars(self), clock)

    @property
    def specs(self) -> tuple[AgentSpec | GovernorSpec | None, ...]:
        """Return the specifications of all agents, and last that of the governor, or None."""
        return *self.agents, self.governor

    @property
    def schedule(self) -> Schedule:
        """Return the length, the worlds of each replica, and how often its agents learn."""
        return Schedule(**{name: getattr(self, name) for name in hints_of(Schedule)})

    def __post_init__(self) -> None:
        if isinstance(self.game, type):
            raise refusal("experiment.game", self.game, f"a game, such as {self.game.__name__}(...)")
        super().__post_init__()
        if isinstance(self.game, PlayableGame):
            checked("experiment.game.agents", self.game.agents, Positive)
        self.to_config()
        check_custom_metrics(self.metrics)
        _check_numbers(self)
        _check_earlier(self)
        _check_agents(self, self.schedule)
        _check_governor(self)
        _check_engine(self)

    def to_config(self) -> dict[str, Any]:
        values = {name: getattr(self, name) for name in hints_of(type(self))}
        values["game"] = stored_game(self.game)
        return {name: to_config(value, f"experiment.{name}") for name, value in values.items()}

    @classmethod
    def from_config(cls, table: Mapping[str, Any]) -> "Experiment":
        """Return the experiment of a table of `to_config`; of the modules that it names only the game's is
        imported."""
        read = build(cls, table, "experiment")
        return read if not isinstance(read.game, Custom) else replace(read, game=game_of(read.game))

    def to_recipe(self, directory: str | Path | None = None) -> dict[str, Any]:
        """Return the content of `recipe.json`; `cprl.runs.recipe.start_run` adds the time and versions.

        Args:
            directory: the directory of the recipe, to which runs of `Frozen` agents are then relative.
        """
        table = self.to_config()
        table = table if directory is None else with_runs_moved(table, ".", directory)
        return {"format": RECIPE_FORMAT, "recipe": self.name, "experiment": table}

    @classmethod
    def from_recipe(cls, recipe: Mapping[str, Any], *, directory: str | Path | None = None) -> "Experiment":
        """Return the experiment of a recipe, as `recipe.json` holds it.

        Args:
            directory: the directory of the recipe; runs of `Frozen` agents become relative to the working
                directory.
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
        tables = [{**each.to_config(), "engine": engine_of(each)} for each in (self, other)]
        return tables[0] == tables[1]

    def __hash__(self) -> int:
        return hash((self.name, self.length, self.replicas, self.seed))


def changes(before: Experiment, now: Experiment) -> list[str]:
    """Return the differences between two experiments, a sentence for each."""
    return describe_changes(before.to_config(), now.to_config(), "experiment", Experiment)


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


def _check_earlier(experiment: Experiment) -> None:
    worlds = experiment.worlds
    steps_before = 0
    for index, part in enumerate(experiment.earlier):
        name = f"experiment.earlier[{index}].steps"
        if experiment.steps is None:
            raise ValueError(f"{name} is {part.steps}; allowed in a training of steps, not of episodes")
        most = experiment.steps - steps_before - worlds
        if not worlds <= part.steps <= most:
            after = f", after {steps_before} steps" if steps_before else ""
            raise ValueError(
                f"{name} is {part.steps}; allowed in {experiment.steps} steps of {worlds} worlds{after}: "
                f"{worlds} to {most}, so that each game has a turn"
            )
        steps_before += part.steps


def _check_agents(experiment: Experiment, schedule: Schedule) -> None:
    if not isinstance(experiment.game, Custom):
        try:
            specs_by_agent(experiment.agents, experiment.game.agents)
            refuse_undecided(experiment.agents, len(getattr(experiment.game, "ballots", ())))
        except ValueError as error:
            raise ValueError(f"experiment.agents: {error}") from error
    for index, spec in enumerate(experiment.agents):
        where = f"experiment.agents[{index}]"
        for place, stored in stored_in(spec).items():
            _check_stored(f"{where}{place}", stored, experiment.replicas)
        if isinstance(spec, Learning | Team) and not isinstance(experiment.game, Custom):
            check_reward(f"{where}.reward", spec.reward, experiment.game.agents)
        if isinstance(spec, Team) and isinstance(spec.algorithm, TeamAlgorithm):
            spec.algorithm.check_team(len(spec.agents), spec.reward)
        settings = _check_settings(where, spec, schedule.worlds)
        rollout_steps = getattr(settings, "rollout_steps", schedule.update_every)
        schedule.refuse_rollouts(rollout_steps, f"{where}.algorithm.settings.rollout_steps")


def _check_governor(experiment: Experiment) -> None:
    spec = experiment.governor
    if spec is None:
        if experiment.governor_from_step:
            raise ValueError(
                f"experiment.governor_from_step is {experiment.governor_from_step}; allowed without a "
                "governor: 0"
            )
        return
    governor = getattr(experiment.game, "governor", None)
    if governor is None:
        raise ValueError(f"experiment.governor is {spec}; allowed in a game without a Governor: None")
    if isinstance(spec, ScriptedGovernor):
        spec.check(governor)
    if isinstance(spec, Learning) and spec != Learning(spec.algorithm):
        raise ValueError(f"experiment.governor is {spec}; allowed for a governor: Learning(algorithm) alone")
    if isinstance(spec, Frozen):
        _check_stored("experiment.governor", spec, experiment.replicas)
    _check_settings("experiment.governor", spec, experiment.worlds)


def _check_settings(where: str, spec: Any, worlds: int) -> Any:
    """Return the settings of an agent's algorithm, or None; refuse those that do not fit the worlds."""
    settings: Any = getattr(getattr(spec, "algorithm", None), "settings", None)
    if hasattr(settings, "refuse_worlds"):
        try:
            settings.refuse_worlds(worlds)
        except ValueError as error:
            raise ValueError(f"{where}.algorithm.settings: {error}") from error
    return settings


def _check_stored(where: str, stored: Frozen, replicas: int) -> None:
    if Path(stored.run).is_absolute():
        raise ValueError(
            f"{where}.run is {stored.run}, an absolute path, which is another one on another machine; "
            "allowed: a path relative to where we stand"
        )
    if isinstance(stored.replica, tuple) and len(stored.replica) != replicas:
        raise ValueError(
            f"{where}.replica is {short_repr(stored.replica)}, of {len(stored.replica)} numbers; allowed: "
            f"{replicas} of them, one for each replica of the experiment; one number for all; or None"
        )


def _check_engine(experiment: Experiment) -> None:
    if experiment.engine != "torchrl":
        return
    for index, spec in enumerate(experiment.agents):
        if isinstance(spec, Team) or (isinstance(spec, Learning) and isinstance(spec.algorithm, Tabular)):
            what = "a Team" if isinstance(spec, Team) else "Tabular"
            raise ValueError(
                f'experiment.agents[{index}] is {what}, which engine="torchrl" cannot train; allowed: '
                '"auto", "compiled", "eager"'
            )
