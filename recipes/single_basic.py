"""Experiment 1 of the study: one DQN agent alone on `single_basic`. Does it learn not to strip the board?

    python recipes/single_basic.py                                   the published schedule, 6000 episodes
    python recipes/single_basic.py --schedule short --watch serve    about four minutes, live in the browser

Copy this file and change it: another map, rule, network or loss is one line.
"""

from dataclasses import replace
from pathlib import Path
from typing import Literal

import torch
import tyro

from cprl import CommonsEnv, presets
from cprl.acting import RandomActor, Seats
from cprl.learning import DQNLearner
from cprl.measuring.evaluate import evaluate
from cprl.recording import (
    EpisodeTable,
    ProgressBar,
    Watch,
    save_weights,
    start_run,
    summarise,
    training_curve,
)
from cprl.train import train

PUBLISHED_LINE = "python recipes/single_basic.py --watch serve"


def main(
    *,
    schedule: Literal["published", "short"] = "published",
    variant: presets.Variant = "published",
    episodes: int | None = None,
    evaluation_episodes: int = 100,
    seed: int = 0,
    out: Path | None = None,
    watch: Literal["file", "serve"] = "file",
) -> Path:
    """Trains the agent, evaluates it on fresh worlds, and returns the run's directory.

    Args:
        schedule: the published one, or a short one: 100 episodes, epsilon decays over 50,000 steps.
        variant: the rules and the learner as the study is written, or as it was run.
        episodes: how many to train; by default the schedule's, 6000 or 100.
        evaluation_episodes: fresh episodes for the trained and for the random policy.
        seed: of chance, weights, exploration and replay.
        out: the run's directory; by default a new one under runs/.
        watch: record to a file, or serve the recording live on 127.0.0.1 as well.
    """
    game = presets.game("single_basic", variant=variant)
    settings = presets.learner("single_basic", variant=variant)
    if schedule == "short":
        settings = replace(settings, epsilon_decay_steps=50_000)
    episodes = episodes or (100 if schedule == "short" else 6000)
    title = f"single_basic, {variant}, {schedule} schedule, {episodes} episodes"

    torch.manual_seed(seed)
    torch.set_num_threads(1)
    arguments = {"schedule": schedule, "variant": variant, "episodes": episodes, "seed": seed}
    run = start_run(out, "single_basic", {**arguments, "game": game, "learner": settings})
    env = CommonsEnv(game, seed=seed)
    learner = DQNLearner(game.window_shape, len(game.actions), settings=settings, seed=seed)
    with (
        Watch(run, env, title=title, episodes=episodes, serve=watch == "serve") as viewer,
        EpisodeTable(run / "episodes.parquet") as table,
        ProgressBar(episodes=episodes, episode_steps=game.rules.episode_steps, title="training") as bar,
    ):
        train(env, {0: learner}, episodes=episodes, observers=[table, viewer, bar])
    save_weights(run, {"agent_0": learner.network})

    fresh = CommonsEnv(game, evaluation_episodes, seed=seed + 1)
    greedy = evaluate(fresh, Seats([learner.actor]))
    chance = evaluate(fresh, Seats([RandomActor(len(game.actions), seed=seed)]))
    figure = training_curve(run, title=title, random=chance)
    other_schedule = PUBLISHED_LINE if schedule == "short" else None
    summarise(run, title=title, trained=greedy, chance=chance, figure=figure, published=other_schedule)
    return run


if __name__ == "__main__":
    tyro.cli(main)
