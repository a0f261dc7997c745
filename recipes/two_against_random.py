"""Experiment 4 of the study: a DQN agent beside a random walker on `two_complex`.

    python recipes/two_against_random.py                          8 replicas of 6000 episodes
    python recipes/two_against_random.py --variant as_run         as its program played it

Copy this file and change it: another map, rule, network or loss is one line.
"""

from pathlib import Path

import tyro

from cprl import CommonsEnv, presets
from cprl.acting import Seats, random_lanes
from cprl.learning import LaneLearner
from cprl.measuring.evaluate import evaluate
from cprl.recording import EpisodeTable, ProgressBar, save_weights, start_run, summarise, training_curve
from cprl.train import prepare_process, train

SEATS = (0,)
WALKER = (1,)


def main(
    *,
    replicas: int = 8,
    episodes: int = 6000,
    variant: presets.Variant = "published",
    evaluation_episodes: int = 20,
    seed: int = 0,
    out: Path | None = None,
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
        compile: whether torch compiles the update; needs a C++ compiler, and is several times faster.
    """
    prepare_process(seed)
    game = presets.game("two_complex", variant=variant)
    settings = presets.learner("two_complex", variant=variant)
    title = f"two_against_random, {variant} rules, {replicas} replicas, {episodes} episodes"
    arguments = {"replicas": replicas, "episodes": episodes, "variant": variant, "seed": seed}
    run = start_run(out, "two_against_random", {**arguments, "game": game, "learner": settings})
    agents = LaneLearner(game, seats=SEATS, replicas=replicas, settings=settings, seed=seed, compile=compile)

    def random(seats: tuple[int, ...], worlds: int = 1) -> dict:
        seeds = [(seed, replica, agent) for replica in range(replicas) for agent in seats]
        return {seats: random_lanes(len(game.actions), seeds=seeds, seats=len(seats), worlds=worlds)}

    with (
        EpisodeTable(run / "episodes.parquet") as table,
        ProgressBar(
            episodes=episodes, episode_steps=game.rules.episode_steps, replicas=replicas, title="training"
        ) as bar,
    ):
        env = CommonsEnv(game, replicas, seed=seed)
        train(env, {SEATS: agents}, others=random(WALKER), episodes=episodes, observers=[table, bar])
    save_weights(run, agents.networks())

    fresh = CommonsEnv(game, replicas * evaluation_episodes, seed=seed + 1)
    walker = random(WALKER, evaluation_episodes)
    trained = Seats({SEATS: agents.evaluation_actor(evaluation_episodes), **walker})
    played = {
        "random": evaluate(fresh, Seats(random((0, 1), evaluation_episodes))),
        "trained, epsilon 0.05": evaluate(fresh, trained, explore=True),
    }
    figure = training_curve(run, title=title, random=played["random"])
    summarise(run, title=title, played=played, figure=figure)
    return run


if __name__ == "__main__":
    tyro.cli(main)
