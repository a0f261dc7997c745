"""cprl: common-pool resources and multi-agent reinforcement learning on TorchRL.

Each imports only from those above it:
    libraries    what an upgrade of a library has taken away, said by name
    compat       what relies on private parts of libraries
    checks       what users hand in, as tables by field: what fits, and how a refusal reads
    arguments    the same for the arguments of a function
    keys         the TensorDict entries, their shapes and types
    spaces       what agents observe and may do
    custom       the user's own code, as a text that a recipe can keep
    output       text for the terminal, which may close
    shipped      the recipes that come with cprl
    caches       where compiled code is kept between runs
    compile_clock  whether code is being compiled, and for how long
    times        where the time of a training and of a run goes
    garbage      what a training leaves behind in memory
    process      settings of the process that trains
    compiling    functions compiled by torch
    memory       devices, and what would not fit into their memory
    institutions  rules that people make: boundaries, quotas, taxes, sanctions, votes; numpy alone
    commons      the game: maps, rules, turns; numpy and numba alone
    theory       games with a known answer: herders, appropriation, what apples can bear; numpy alone
    envs         TorchRL, PettingZoo, Gymnasium; make_env, where environments are put together
    games        games of the user's own, as a recipe holds them
    preferences  what agents want: the reward that each learns from
    networks     from observations to numbers
    objectives   losses that TorchRL lacks: log-cosh, MADDPG, PR2, LOLA
    policies     from observations to actions: learned, tabular and scripted agents
    collectors   one step of all worlds after the other
    learners     replay and rollouts, updates of many agents at once
    algorithms   what agents learn by: DQN, PPO, QMIX and so on, frozen values
    population   how each agent is specified: Learning, Team, Scripted, Frozen
    annotations  whether a value is of an annotated type
    config       values as JSON tables, and back
    differences  how two such tables differ
    presets      the published games and hyper-parameters by name
    measuring    social metrics, episodes, phases, statistics
    runs         what is kept of a run: recipe, table of episodes, checkpoints, weights
    viewer       recordings for the Rerun viewer
    terminal     progress, summary, figures
    callbacks    what is called while a training runs
    finite       what is NaN or infinite in a training, found and named
    training     the loop: act, store, update, measure, record
    experiment   Experiment: what is trained and how, a value
    stored_agents  agents of stored runs, as policies
    stored       load: a run built again from its directory
    earlier      agents of earlier runs: that play, and that others start from
    agents       the learners and policies of a population
    outcome      trained agents in fresh worlds, beside the random policy
    parts        what is made of an experiment before anything is written
    leftovers    what a run leaves in its directory: removed, or said
    running      run: an experiment from its learners to its report
    studies      one experiment under many conditions: factors, trials, tables, figures
    evaluation   stored agents in fresh worlds: alone, among each other and people, against best responses
    reporting    finished runs beside the published study
    flags        the fields of an experiment as flags
    commandline  recipe_main: the command line of a recipe
    command_parts  what several commands do alike
    evaluation_cli  cprl film, evaluate, visits, crossplay and schelling
    egta_cli     cprl egta
    scenarios_cli  cprl scenarios
    studies_options  how a study is run, as options of a command line
    studies_cli  cprl sweep and cprl table; study_main: the command line of a recipe of a study
    exploit_cli  cprl exploit
    recipes_cli  cprl recipe, and recipes that cprl run takes by name
    docs_cli     cprl docs
    cli          the command cprl
    __main__     the same as python -m cprl
"""

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, Final

import gymnasium

if TYPE_CHECKING:
    from cprl import (
        algorithms,
        callbacks,
        commons,
        envs,
        evaluation,
        institutions,
        keys,
        learners,
        measuring,
        networks,
        objectives,
        policies,
        population,
        preferences,
        presets,
        reporting,
        spaces,
        studies,
        theory,
        training,
        viewer,
    )
    from cprl.commandline import recipe_main
    from cprl.commons import maps
    from cprl.commons.game import Game
    from cprl.commons.maps import Map
    from cprl.commons.observation import Observation
    from cprl.commons.rules import Rules
    from cprl.custom import Custom
    from cprl.envs import CommonsEnv
    from cprl.evaluation import crossplay, evaluate_run
    from cprl.experiment import Experiment
    from cprl.running import run
    from cprl.stored import load
    from cprl.studies import Study, run_study
    from cprl.studies_cli import study_main
    from cprl.training import train

    __version__: str

__all__ = [
    "CommonsEnv",
    "Custom",
    "Experiment",
    "Game",
    "Map",
    "Observation",
    "Rules",
    "Study",
    "__version__",
    "algorithms",
    "callbacks",
    "commons",
    "crossplay",
    "envs",
    "evaluate_run",
    "evaluation",
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
    "preferences",
    "presets",
    "recipe_main",
    "reporting",
    "run",
    "run_study",
    "spaces",
    "studies",
    "study_main",
    "theory",
    "train",
    "training",
    "viewer",
]

_MODULES: Final = {
    "CommonsEnv": "cprl.envs",
    "Custom": "cprl.custom",
    "Experiment": "cprl.experiment",
    "Game": "cprl.commons.game",
    "Map": "cprl.commons.maps",
    "Observation": "cprl.commons.observation",
    "Rules": "cprl.commons.rules",
    "Study": "cprl.studies",
    "crossplay": "cprl.evaluation",
    "evaluate_run": "cprl.evaluation",
    "load": "cprl.stored",
    "maps": "cprl.commons",
    "recipe_main": "cprl.commandline",
    "run": "cprl.running",
    "run_study": "cprl.studies",
    "study_main": "cprl.studies_cli",
    "train": "cprl.training",
}
"""Where names are that no package is called. All are imported when they are used: torch alone takes seconds,
which `cprl --help` and mistyped commands need not wait for."""


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return version("cprl")
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name in _MODULES:
        return getattr(import_module(_MODULES[name]), name)
    return import_module(f"cprl.{name}")


def __dir__() -> list[str]:
    return list(__all__)


def _register() -> None:
    """Registers the boards for one agent with `gymnasium.make`, which imports them when it makes one."""
    gymnasium.register("cprl/Commons-v0", entry_point="cprl.envs.gymnasium_env:CommonsGymnasiumEnv")
    for name, board in (("SingleBasic", "single_basic"), ("SingleComplex", "single_complex")):
        gymnasium.register(
            f"cprl/{name}-v0", entry_point="cprl.presets:gymnasium_env", kwargs={"board": board}
        )


_register()
