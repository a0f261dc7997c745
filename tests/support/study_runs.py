"""Small runs of a study whose numbers are known, written as a training writes them."""

import json
from itertools import product

import numpy as np

import cprl
from cprl import Game, Rules, maps, presets
from cprl.algorithms import DQN
from cprl.measuring import Episode
from cprl.measuring.registry import OPTIONAL_ENTRIES, metrics_for
from cprl.population import Learning
from cprl.runs.episodes import EpisodeTable
from cprl.runs.recipe import start_run
from cprl.studies.trials import trials_of
from cprl.training.evaluating import write_evaluation

EXPERIMENT = cprl.Experiment(
    name="tiny",
    game=Game(map=maps.parse(">A.<\n.A.."), rules=Rules(freeze_steps=5)),
    agents=(Learning(DQN(settings=presets.dqn_settings("commons"))),) * 2,
    episodes=40,
    replicas=2,
    evaluation_episodes=3,
    seed=7,
)
TIME_OUT = "game.rules.freeze_steps"

STORED = metrics_for(OPTIONAL_ENTRIES)[:-1]


def an_episode(number, replica, apples, **metrics):
    """An episode in which two agents harvest so many apples, the first all but one."""
    harvest = np.array([apples - 1.0, 1.0])
    return Episode(
        world=replica,
        episode=number,
        steps=100,
        terminated=False,
        return_=harvest,
        harvest=harvest,
        in_play_steps=np.array([100, 100]),
        shots=np.array([0, 0]),
        hits=np.array([0, 0]),
        tagged=np.array([0, 0]),
        tagged_by=np.zeros((2, 2), int),
        stock_left=1,
        depletion_step=-1,
        metrics={**dict.fromkeys(STORED, 0.5), "collective_return": apples, **metrics},
    )


def write_run(run, experiment, apples, *, random=4.0, equality=None, is_finished=True, **recipe):
    """A run whose episodes bring so many apples.

    Args:
        apples: gives the harvest of an episode from its replica and number; in the evaluation from -1.
        random: the harvest of random play.
        equality: gives the equality from replica and episode, 0.5 if None.
        is_finished: whether there is a report.
        recipe: entries of the recipe instead of those of this process.
    """
    start_run(run, experiment.name, experiment.to_recipe)
    if recipe:
        held = json.loads((run / "recipe.json").read_text())
        (run / "recipe.json").write_text(json.dumps({**held, **recipe}))
    with EpisodeTable(run / "episodes.parquet") as table:
        for number in range(experiment.episodes):
            for replica in range(experiment.replicas):
                more = {} if equality is None else {"equality": equality(replica, number)}
                table.add(an_episode(number, replica, float(apples(replica, number)), **more))
    places = list(product(range(experiment.replicas), range(experiment.evaluation_episodes)))
    trained = [an_episode(number, replica, float(apples(replica, -1))) for replica, number in places]
    by_chance = [an_episode(number, replica, float(random)) for replica, number in places]
    played = {"trained": trained, "random": by_chance}
    write_evaluation(run, played, replicas=experiment.replicas)
    if is_finished:
        (run / "report.json").write_text("{}")
    return run


def write_study(study, runs, apples, *, but=(), **options):
    """The runs of a study, but for those of some conditions.

    Args:
        apples: gives the harvest of an episode from condition, replica of the study, and episode.
        but: names of conditions.
        options: see `write_run`.
    """
    for trial in trials_of(study):
        if trial.condition.name not in but:
            first, condition = trial.block.first, trial.condition

            def of(replica, number, first=first, condition=condition):
                return apples(condition, first + replica, number)

            write_run(runs / trial.name, trial.experiment, of, **options)
    return runs
