"""A training loop of your own with cprl's callbacks: one DQN agent alone on `single_basic`.

    python recipes/own_loop.py --watch serve

The loop is that of `cprl.learners.plain.train_plainly`, in which an agent learns by TorchRL's stock parts;
the run directory, the live view, the best weights and the summary are cprl's. It has no checkpoints, and is
several times slower than the other recipes. Its schedule is its own: the published one
(recipes/single_basic.py, with 8 replicas) takes an hour. Without cprl's parts the same agent is
examples/other_trainers/single_agent.py.
"""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from math import nan
from pathlib import Path
from statistics import fmean

import pyarrow as pa
import torch
import tyro
from torch import nn
from torchrl.record.loggers import Logger

import cprl
from cprl import CommonsEnv, presets
from cprl.algorithms import DQN
from cprl.algorithms.base import q_actor
from cprl.commands.recipe_command import exit_with_message
from cprl.learners.lanes import Lanes
from cprl.learners.learner import Learner
from cprl.measuring.playing import evaluate, mean_return
from cprl.measuring.series import Observer
from cprl.measuring.table import labelled, where
from cprl.measuring.tracker import Episode, EpisodeTracker
from cprl.policies.actors import RandomActor
from cprl.policies.joint_policy import JointPolicy
from cprl.population import Learning, exploration_steps
from cprl.runs.episodes import EpisodeTable, table_of
from cprl.runs.recipe import start_run
from cprl.runs.schedule import Schedule
from cprl.runs.weights import load_weights, save_weights
from cprl.system.output import quote_command, say
from cprl.system.shipped import cprl_command
from cprl.terminal.figures import training_curve
from cprl.terminal.progress import ProgressBar
from cprl.terminal.summary import summarise
from cprl.training.training import Callback, StepCollector
from cprl.viewer.callback import ViewerCallback
from cprl.viewer.page import check_watch

SHORT = {"epsilon_decay_steps": 30_000, "batch_size": 64, "learning_rate": 3e-4, "target_every_episodes": 1}
"""The differences from the published schedule, besides the number of episodes: it has to learn from 1/50 of
the steps."""


class BestWeights:
    """A callback that evaluates the greedy policy every `every` episodes, and saves the best weights so far.

    It evaluates in the same worlds every time, so measure the saved weights
    in other worlds. A policy that harvests nothing is never the best, where the game reports harvests; until
    one harvests something `path` is None and `best_episode` is -1.
    """

    def __init__(
        self,
        run: Path,
        networks: Callable[[], Mapping[str, nn.Module]],
        *,
        policy: nn.Module,
        env: CommonsEnv,
        every: int = 10,
        logger: Logger | None = None,
    ) -> None:
        self.run = run
        self.networks = networks
        self.policy = policy
        self.env = env
        self.every = every
        self.logger = logger
        self.seed = int(env.worlds.now.seed[0, 0])
        self.path: Path | None = None
        self.best_return = float("-inf")
        self.best_episode = -1
        self._episodes = 0

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        """Count an episode; every `every` episodes evaluate, and save the weights if they are better."""
        self._episodes += 1
        if self._episodes % self.every:
            return
        self.env.set_seed(self.seed)
        played = evaluate(self.env, self.policy)
        reached, _ = mean_return(played)
        if self.logger is not None:
            self.logger.log_scalar("evaluation/greedy_return", reached)
        harvests = [episode.harvest for episode in played if episode.harvest is not None]
        if harvests and not any(harvest.any() for harvest in harvests):
            return
        if reached > self.best_return:
            self.best_return = reached
            self.best_episode = self._episodes
            self.path = save_weights(self.run, self.networks(), name="best")


def main(
    *,
    episodes: int = 120,
    evaluation_episodes: int = 100,
    seed: int = 0,
    out: Path | None = None,
    watch: str = "file",
) -> Path:
    """Train the agent, evaluate it on fresh worlds, and return the run's directory.

    Args:
        episodes: how many to train.
        evaluation_episodes: fresh episodes for the trained and for the random policy.
        seed: of chance, weights, exploration and replay.
        out: the run's directory; by default a new one under runs/.
        watch: "file", or live as well: "serve" on 127.0.0.1, "spawn" a viewer.
    """
    check_watch(watch, can_be_off=False)
    game = presets.game("single_basic")
    algorithm = DQN(settings=replace(presets.dqn_settings("single_basic"), **SHORT))
    title = f"single_basic, published rules, short schedule, {episodes} episodes"
    experiment = cprl.Experiment(
        name="own_loop",
        game=game,
        agents=(Learning(algorithm),),
        episodes=episodes,
        seed=seed,
        evaluation_episodes=evaluation_episodes,
    )

    torch.set_num_threads(1)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    run = start_run(out, experiment.name, experiment.to_recipe)
    env = CommonsEnv(game, seed=seed)
    trial = CommonsEnv(game, 16, seed=seed + 1)

    lanes = Lanes(game.spaces, agents=(0,), replicas=1, seed=seed)
    learner = algorithm.make_learner(lanes, "torchrl")
    policy = JointPolicy({(0,): learner.evaluation_actor(worlds=16)})

    def networks() -> dict[str, nn.Module]:
        return {"agent_0": learner.networks()["replica_0/agent_0"]}

    recipe = experiment.to_config()
    live = None if watch == "file" else watch
    with (
        ViewerCallback(run, env, title=title, episodes=episodes, recipe=recipe, live=live) as viewer,
        EpisodeTable(run / "episodes.parquet") as table,
        ProgressBar(Schedule(episodes=episodes), game) as bar,
    ):
        best = BestWeights(run, networks, policy=policy, env=trial, logger=viewer.logger)
        callbacks = [table, viewer, best, bar]
        learn(env, learner, episodes, callbacks=callbacks)
    save_weights(run, networks())

    fresh = CommonsEnv(game, evaluation_episodes, seed=seed + 2)
    played = {"random": evaluate(fresh, JointPolicy([RandomActor(len(game.actions), seed=seed)]))}
    network = networks()["agent_0"]
    greedy = JointPolicy([q_actor(network)])
    played["greedy, last"] = evaluate(fresh, greedy)
    if best.path:
        network.load_state_dict(load_weights(best.path)["agent_0"])
        played[f"greedy, best (episode {best.best_episode})"] = evaluate(fresh, greedy)
    ends = exploration_steps(experiment.agents)
    table = pa.concat_tables(labelled(table_of(episodes), policy=name) for name, episodes in played.items())
    random = where(table, policy="random")
    figure = training_curve(run, title=title, random=random, exploration_turns=ends)
    note = None if best.path else "No best weights: greedy play harvested nothing whenever it was tried"
    summarise(run, title=title, played=table, figure=figure, note=note)
    published = quote_command([*cprl_command(), "run", "single_basic"])
    say(f"This was a shortened schedule. The published one, with 8 replicas: {published}")
    return run


def learn(env: CommonsEnv, learner: Learner, episodes: int, *, callbacks: Sequence[Callback]) -> None:
    """Act, store, learn and measure, turn by turn."""
    tracker = EpisodeTracker(1, env.game.agents)
    observer = Observer(callbacks, env)
    losses: list[float] = []
    for turn in StepCollector(env, JointPolicy({learner.agents: learner.actor})):
        learner.store(turn)
        loss = learner.update()
        if loss is not None:
            losses.append(loss.item())
        observer.on_step(turn)
        for episode in tracker.add(turn):
            learning = {
                "agent_0/loss": fmean(losses) if losses else nan,
                "agent_0/epsilon": learner.actor.epsilon,
                "agent_0/q": learner.values(turn).item(),
            }
            losses.clear()
            learner.end_episode(turn["next", "done"][:, 0])
            observer.on_episode(episode, learning)
            if episode.episode + 1 == episodes:
                return


if __name__ == "__main__":
    with exit_with_message("own_loop.py"):
        tyro.cli(main)
