"""How some public names are called, and what is looked at where they accept."""

from collections.abc import Callable
from typing import Any, Final

import cprl
from cprl.exploiting import exploitability
from cprl.terminal.figures import training_curve

from . import runs
from .cases import Case

OF_FILES: Final = {
    "cprl.commandline:recipe_main",
    "cprl.evaluation.cross_play:crossplay",
    "cprl.evaluation.empirical_game:play_empirical_game",
    "cprl.evaluation.evaluate:evaluate_run",
    "cprl.evaluation.populations:play_population",
    "cprl.evaluation.responses:play_responses",
    "cprl.evaluation.schelling:schelling",
    "cprl.evaluation.schelling_picture:draw_schelling",
    "cprl.evaluation.scenarios.suite:run_scenarios",
    "cprl.evaluation.territory:territory_of",
    "cprl.evaluation.visits_picture:draw_visits",
    "cprl.exploiting.exploit:exploitability",
    "cprl.exploiting.plan:plan_responses",
    "cprl.reporting.report:write_report",
    "cprl.running:run",
    "cprl.runs.directory:start_run",
    "cprl.runs.episodes:EpisodeTable",
    "cprl.runs.episodes:read_episodes",
    "cprl.runs.episodes:read_table",
    "cprl.runs.export:export_results",
    "cprl.runs.loggers:LoggerCallback",
    "cprl.runs.weights:BestWeights",
    "cprl.runs.weights:restore_weights",
    "cprl.runs.weights:save_decisions",
    "cprl.runs.weights:save_weights",
    "cprl.stored:load",
    "cprl.terminal.figures:training_curve",
    "cprl.terminal.summary:summarise",
    "cprl.viewer.callback:ViewerCallback",
    "cprl.viewer.logger:RerunLogger",
}
"""Those that read or write files: each case has a folder of its own, and an OSError is an answer."""

SLOW: Final = {
    "cprl.commandline:recipe_main",
    "cprl.evaluation.cross_play:crossplay",
    "cprl.evaluation.empirical_game:play_empirical_game",
    "cprl.evaluation.evaluate:evaluate_run",
    "cprl.evaluation.populations:play_population",
    "cprl.evaluation.responses:play_responses",
    "cprl.evaluation.schelling:schelling",
    "cprl.evaluation.schelling_picture:draw_schelling",
    "cprl.evaluation.scenarios.suite:run_scenarios",
    "cprl.evaluation.territory:territory_of",
    "cprl.evaluation.visits_picture:draw_visits",
    "cprl.exploiting.exploit:exploitability",
    "cprl.exploiting.plan:plan_responses",
    "cprl.reporting.report:write_report",
    "cprl.running:run",
    "cprl.terminal.figures:training_curve",
    "cprl.measuring.phases:find_phases",
    "cprl.measuring.phases:change_points",
    "cprl.theory.evolution:replicator_ends",
}
"""Those of which a case may take a tenth of a second or more."""


def _train(case: Case) -> Any:
    with runs.stopped_after(2):
        return cprl.train(**case.arguments)


def _run(case: Case) -> Any:
    with runs.stopped_after(2):
        return cprl.run(**case.arguments)


def _exploitability(case: Case) -> Any:
    with runs.stopped_after(2):
        return exploitability(**case.arguments)


def _training_curve(case: Case) -> Any:
    name = getattr(case.arguments.get("run"), "name", "")
    own = {"run": runs.copied(name)} if name in runs.NAMES[:4] else {}
    return training_curve(**{**case.arguments, **own})


def _recipe_main(case: Case) -> Any:
    with runs.stopped_after(2):
        return cprl.recipe_main(**case.arguments)


CALLS: Final[dict[str, Callable[[Case], Any]]] = {
    "cprl.training:train": _train,
    "cprl.exploiting.exploit:exploitability": _exploitability,
    "cprl.terminal.figures:training_curve": _training_curve,
    "cprl.running:run": _run,
    "cprl.commandline:recipe_main": _recipe_main,
}
"""Those that are not simply called: trainings are stopped after two steps."""


def _plays(case: Case, env: Any) -> str | None:
    """An environment that was accepted plays two turns."""
    cells = env.game.map.height * env.game.map.width * env.batch_size.numel()
    if cells > 10_000:
        return None
    env.rollout(2)
    return None


AFTER: Final[dict[str, Callable[[Case, Any], str | None]]] = {
    "cprl.envs.commons_env:CommonsEnv": _plays,
}
