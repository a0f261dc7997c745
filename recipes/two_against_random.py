"""Experiment 4 of the study: a DQN agent beside a random walker on `two_complex`.

    python recipes/two_against_random.py                          8 replicas of 6000 episodes

Copy this file and change it: another map, rule, network or loss is one line.
"""

from functools import partial
from pathlib import Path

import tyro

from cprl import CommonsEnv, presets, recording
from cprl.acting import Seats, random_seats
from cprl.learning import LaneLearner
from cprl.measuring.evaluate import evaluate
from cprl.train import prepare_process, train

SEATS, WALKER = (0,), (1,)


def main(
    *,
    replicas: int = 8,
    episodes: int = 6000,
    variant: presets.Variant = "published",
    evaluation_episodes: int = 20,
    seed: int = 0,
    out: Path | None = None,
    go_on: bool = False,
    compile: bool = True,
) -> Path:
    """Trains the agents of all replicas, evaluates them on fresh worlds, and returns the run's directory.

    Args:
        replicas: independent repetitions of the whole training, side by side.
        episodes: how many each trains.
        variant: the rules and the learner as the study is written, or as it was run.
        evaluation_episodes: fresh episodes for each replica, with epsilon 0.05, and for the random policy.
        seed: of chance, weights, exploration and replay.
        out: the run's directory; by default a new one under runs/.
        go_on: with the run in `out`, which was stopped; bit for bit as if it had not been.
        compile: whether torch compiles the update; needs a C++ compiler, and is several times faster.
    """
    prepare_process(seed)
    game = presets.game("two_complex", variant=variant)
    settings = presets.learner("two_complex", variant=variant)
    title = f"two_against_random, {variant} rules, {replicas} replicas, {episodes} episodes"
    arguments = {"replicas": replicas, "episodes": episodes, "variant": variant, "seed": seed}
    recipe = {**arguments, "game": game, "learner": settings}
    run = recording.start_run(out, "two_against_random", recipe, go_on=go_on)
    agents = LaneLearner(game, seats=SEATS, replicas=replicas, settings=settings, seed=seed, compile=compile)
    random = partial(random_seats, game, replicas=replicas, seed=seed)

    with (
        recording.Checkpoints(run) as checkpoints,
        recording.EpisodeTable(run / "episodes.parquet", resumable=True) as table,
        recording.ProgressBar(game, episodes=episodes, replicas=replicas) as bar,
    ):
        env = CommonsEnv(game, replicas, seed=seed)
        seats, others, observers = {SEATS: agents}, random(WALKER), [table, bar]
        train(env, seats, others=others, episodes=episodes, observers=observers, checkpoints=checkpoints)
        recording.save_weights(run, agents.networks())

    fresh = CommonsEnv(game, replicas * evaluation_episodes, seed=seed + 1)
    actors = {SEATS: agents.evaluation_actor(evaluation_episodes)}
    trained = Seats({**actors, **random(WALKER, worlds=evaluation_episodes)})
    played = {
        "random": evaluate(fresh, Seats(random((0, 1), worlds=evaluation_episodes))),
        "trained, epsilon 0.05": evaluate(fresh, trained, explore=True),
    }
    figure = recording.training_curve(run, title=title, random=played["random"])
    recording.summarise(run, title=title, played=played, figure=figure)
    return run


if __name__ == "__main__":
    tyro.cli(main)
