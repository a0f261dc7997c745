"""cprl: common-pool resources and multi-agent reinforcement learning on TorchRL.

A package imports only from those above it:
    values       frozen values: a field's annotation says its range; tables that JSON holds, and back; Custom
    system       compilation, caches, memory, output, private parts of libraries
    keys         the TensorDict entries, their shapes and types; recurrent states from turn to turn
    institutions  rules that people make: boundaries, quotas, taxes, sanctions, votes; numpy alone
    commons      the game: maps, rules, turns; numpy and numba alone
    pictures     games for people: boards as images, rules in words, the colours of all pictures
    envs         TorchRL, PettingZoo, Gymnasium; make_env, where environments are put together
    networks     from observations to numbers
    objectives   what agents want, and losses that TorchRL lacks: log-cosh, MADDPG, PR2, LOLA
    policies     from observations to actions: learned, tabular and scripted agents
    learners     replay and rollouts, updates of many agents at once
    algorithms   what agents learn by: DQN, PPO, QMIX and so on, frozen values
    population   how each agent is specified: Learning, Team, Scripted, Language, Frozen, Pool, Person
    measuring    social metrics, episodes, outcomes, statistics
    runs         what is kept of a run: recipe, table of episodes, checkpoints, weights
    experiment   Experiment: what is trained and how, a value; presets: what was published, by name
    viewer       recordings for the Rerun viewer
    terminal     progress, summary, figures
    training     the loop: act, store, update, measure, record; run, load
    evaluation   stored agents in fresh worlds: alone, among each other and people
    studies      one experiment under many conditions: factors, trials, tables, figures
    web          pages for a browser: episodes, reports, the explorable, games that people play
    experimental  the waiting room, which may change and which no other package imports
    commands     the command line
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

from cprl.system.libraries import quiet_in_notebooks, when_imported

if TYPE_CHECKING:
    from cprl import (
        algorithms,
        commons,
        envs,
        evaluation,
        experimental,
        institutions,
        keys,
        learners,
        measuring,
        networks,
        objectives,
        policies,
        population,
        studies,
        training,
        viewer,
    )
    from cprl.commands.recipe_command import recipe_main
    from cprl.commands.studies import study_main
    from cprl.commons import maps
    from cprl.commons.game import Game
    from cprl.commons.maps import Map
    from cprl.commons.observation import Observation
    from cprl.commons.quirks import Quirks2019
    from cprl.commons.river import River
    from cprl.commons.rules import RandomEnd, Rules
    from cprl.envs import CommonsEnv
    from cprl.evaluation import crossplay, evaluate_run, gains
    from cprl.experiment import EarlierGame, Experiment, presets
    from cprl.measuring.statistics import differences, estimates
    from cprl.runs.schedule import Schedule
    from cprl.studies import Study, run_study
    from cprl.system.defaults import Fresh
    from cprl.training import train
    from cprl.training.running import run
    from cprl.training.stored import load
    from cprl.values import Custom, trust

    __version__: str

__all__ = [
    "CommonsEnv",
    "Custom",
    "EarlierGame",
    "Experiment",
    "Fresh",
    "Game",
    "Map",
    "Observation",
    "Quirks2019",
    "RandomEnd",
    "River",
    "Rules",
    "Schedule",
    "Study",
    "__version__",
    "algorithms",
    "commons",
    "crossplay",
    "differences",
    "envs",
    "estimates",
    "evaluate_run",
    "evaluation",
    "experimental",
    "gains",
    "institutions",
    "keys",
    "learners",
    "load",
    "maps",
    "measuring",
    "networks",
    "objectives",
    "policies",
    "population",
    "presets",
    "recipe_main",
    "run",
    "run_study",
    "studies",
    "study_main",
    "train",
    "training",
    "trust",
    "viewer",
]

_MODULES: Final = {
    "CommonsEnv": "cprl.envs",
    "Custom": "cprl.values",
    "EarlierGame": "cprl.experiment",
    "Experiment": "cprl.experiment",
    "Fresh": "cprl.system.defaults",
    "Game": "cprl.commons.game",
    "Map": "cprl.commons.maps",
    "Observation": "cprl.commons.observation",
    "Quirks2019": "cprl.commons.quirks",
    "RandomEnd": "cprl.commons.rules",
    "River": "cprl.commons.river",
    "Rules": "cprl.commons.rules",
    "Schedule": "cprl.runs.schedule",
    "Study": "cprl.studies",
    "crossplay": "cprl.evaluation",
    "differences": "cprl.measuring.statistics",
    "estimates": "cprl.measuring.statistics",
    "evaluate_run": "cprl.evaluation",
    "gains": "cprl.evaluation",
    "load": "cprl.training.stored",
    "recipe_main": "cprl.commands.recipe_command",
    "run": "cprl.training.running",
    "run_study": "cprl.studies",
    "study_main": "cprl.commands.studies",
    "train": "cprl.training",
    "trust": "cprl.values",
}
"""Where names are that no package is called. All are imported when they are used: torch alone takes seconds,
which `cprl --help` and mistyped commands need not wait for."""
_INNER: Final = {"maps": "cprl.commons.maps", "presets": "cprl.experiment.presets"}
"""Modules within packages."""


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("cprl")
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name in _MODULES:
        return getattr(import_module(_MODULES[name]), name)
    return import_module(_INNER.get(name, f"cprl.{name}"))


def __dir__() -> list[str]:
    return list(__all__)


_PRESETS = "cprl.experiment.presets"


def _register() -> None:
    """Register games with `gymnasium.make`, as played by one agent, which imports them when it makes one."""
    import gymnasium

    from cprl.commons.literature import LITERATURE_GAMES

    gymnasium.register("cprl/Commons-v0", entry_point="cprl.envs.gymnasium_env:CommonsGymnasiumEnv")
    games = {"cprl/SingleBasic-v0": "single_basic", "cprl/SingleComplex-v0": "single_complex"}
    games |= {name: name for name in LITERATURE_GAMES}
    for gym_id, name in games.items():
        gymnasium.register(gym_id, entry_point=f"{_PRESETS}:gymnasium_env", kwargs={"name": name})


def _register_parallel() -> None:
    """Register games with `pettingzoo.make`, as a parallel environment of all agents."""
    import pettingzoo

    from cprl.commons.literature import LITERATURE_GAMES

    if hasattr(pettingzoo, "register"):  # since 1.27
        for name in LITERATURE_GAMES:
            pettingzoo.register(
                "parallel", name, entry_point=f"{_PRESETS}:pettingzoo_env", kwargs={"name": name}
            )


quiet_in_notebooks()
when_imported("gymnasium", _register)
when_imported("pettingzoo", _register_parallel)
