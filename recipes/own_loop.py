"""A training loop of your own with cprl's callbacks: one DQN agent alone on `single_basic`.

    python recipes/own_loop.py --watch serve

The loop is made of TorchRL's replay buffer, `QValueActor`, `EGreedyModule` and `DQNLoss`; the run directory,
the live view, the best weights and the summary are cprl's. It has no checkpoints, and is several times slower
than the other recipes, in which cprl does all this for many agents at once. Its schedule is its own: the
published one (recipes/single_basic.py, with 8 replicas) takes an hour. Without cprl's parts the same agent is
examples/single_agent.py.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import nan
from pathlib import Path
from statistics import fmean

import pyarrow as pa
import torch
import tyro
from tensordict.nn import TensorDictSequential
from torch import nn
from torchrl.data import Categorical, LazyTensorStorage, TensorDictReplayBuffer
from torchrl.modules import EGreedyModule, QValueActor
from torchrl.objectives import DQNLoss, HardUpdate
from torchrl.record.loggers import Logger

import cprl
from cprl import CommonsEnv, presets
from cprl.algorithms import DQN
from cprl.commands.recipe import in_a_sentence
from cprl.learners.settings import DQNSettings
from cprl.learners.transitions import transitions_of
from cprl.measuring.episodes import Episode, EpisodeTracker
from cprl.measuring.evaluate import evaluate, mean_return
from cprl.measuring.series import Observer
from cprl.measuring.table import labelled, where
from cprl.networks.mlp import MLPNetwork
from cprl.policies.assignment import AgentPolicies
from cprl.policies.lanes import RandomActor
from cprl.population import Learning, exploration_steps
from cprl.runs.episodes import EpisodeTable, table_of
from cprl.runs.recipe import start_run
from cprl.runs.weights import load_weights, save_weights
from cprl.system.output import printed, say
from cprl.system.shipped import cprl_here
from cprl.terminal.figures import training_curve
from cprl.terminal.progress import ProgressBar
from cprl.terminal.summary import summarise
from cprl.training.training import Callback, StepCollector
from cprl.viewer.callback import ViewerCallback
from cprl.viewer.page import check_watch

SHORT = {"epsilon_decay_steps": 30_000, "batch_size": 64, "learning_rate": 3e-4, "target_every_episodes": 1}
"""What differs from the published schedule, besides the number of episodes: it has to learn from 1/50 of the
steps."""


class BestWeights:
    """Evaluates the greedy policy every `every` episodes, and saves the best weights so far.

    A callback of `cprl.training`. It evaluates in the same worlds every time, so measure the saved weights
    in other worlds. A policy that harvests nothing is never the best, where the game reports harvests; until
    one harvests something `path` is None and `best_episode` is -1.
    """

    def __init__(
        self,
        run: Path,
        networks: Mapping[str, nn.Module],
        *,
        policy: nn.Module,
        env: CommonsEnv,
        every: int = 10,
        logger: Logger | None = None,
    ) -> None:
        self.run, self.networks, self.policy, self.env = run, networks, policy, env
        self.every, self.logger = every, logger
        self.seed = int(env.worlds.now.seed[0, 0])
        self.path: Path | None = None
        self.best_return, self.best_episode, self._episodes = float("-inf"), -1, 0

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        """Counts an episode; every `every` episodes evaluates, and saves the weights if they are better."""
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
            self.best_return, self.best_episode = reached, self._episodes
            self.path = save_weights(self.run, self.networks, name="best")


def main(
    *,
    episodes: int = 120,
    evaluation_episodes: int = 100,
    seed: int = 0,
    out: Path | None = None,
    watch: str = "file",
) -> Path:
    """Trains the agent, evaluates it on fresh worlds, and returns the run's directory.

    Args:
        episodes: how many to train.
        evaluation_episodes: fresh episodes for the trained and for the random policy.
        seed: of chance, weights, exploration and replay.
        out: the run's directory; by default a new one under runs/.
        watch: "file", or live as well: "serve" on 127.0.0.1, "spawn" a viewer.
    """
    check_watch(watch, can_be_off=False)
    game = presets.game("single_basic")
    settings = replace(presets.dqn_settings("single_basic"), **SHORT)
    title = f"single_basic, published rules, short schedule, {episodes} episodes"
    experiment = cprl.Experiment(
        name="own_loop",
        game=game,
        agents=(Learning(DQN(settings=settings)),),
        episodes=episodes,
        seed=seed,
        evaluation_episodes=evaluation_episodes,
    )

    torch.manual_seed(seed)
    torch.set_num_threads(1)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    run = start_run(out, experiment.name, experiment.to_recipe)
    env, trial = CommonsEnv(game, seed=seed), CommonsEnv(game, 16, seed=seed + 1)

    network = MLPNetwork(
        game.observation_shape,
        len(game.actions),
        hidden_cells=settings.hidden_cells,
        highest=game.observation.highest,
    )
    spec = Categorical(len(game.actions), shape=(), dtype=torch.int64)
    greedy = QValueActor(network, spec=spec, action_space="categorical")
    explore = EGreedyModule(spec=spec, eps_init=settings.epsilon_start, eps_end=settings.epsilon_end)
    policy = AgentPolicies([TensorDictSequential(greedy, explore)])  # explores under ExplorationType.RANDOM
    loss = DQNLoss(greedy, loss_function="l2", action_space="categorical", delay_value=True)
    loss.make_value_estimator(gamma=settings.gamma)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(settings.buffer_size),
        batch_size=settings.batch_size,
        generator=torch.Generator().manual_seed(seed),
    )

    networks = {"agent_0": network}
    live, shown = None if watch == "file" else watch, experiment.to_config()
    with (
        ViewerCallback(run, env, title=title, episodes=episodes, recipe=shown, live=live) as viewer,
        EpisodeTable(run / "episodes.parquet") as table,
        ProgressBar(game, episodes=episodes) as bar,
    ):
        best = BestWeights(run, networks, policy=policy, env=trial, logger=viewer.logger)
        callbacks = [table, viewer, best, bar]
        learn(env, policy, network, explore, loss, buffer, settings, episodes, callbacks=callbacks)
    save_weights(run, networks)

    fresh = CommonsEnv(game, evaluation_episodes, seed=seed + 2)
    played = {"random": evaluate(fresh, AgentPolicies([RandomActor(len(game.actions), seed=seed)]))}
    played["greedy, last"] = evaluate(fresh, policy)
    if best.path:
        network.load_state_dict(load_weights(best.path)["agent_0"])
        played[f"greedy, best (episode {best.best_episode})"] = evaluate(fresh, policy)
    ends = exploration_steps(experiment.agents)
    table = pa.concat_tables(labelled(table_of(episodes), policy=name) for name, episodes in played.items())
    random = where(table, policy="random")
    figure = training_curve(run, title=title, random=random, exploration_turns=ends)
    note = None if best.path else "No best weights: greedy play harvested nothing whenever it was tried"
    summarise(run, title=title, played=table, figure=figure, note=note)
    published = printed([*cprl_here(), "run", "single_basic"])
    say(f"This was a shortened schedule. The published one, with 8 replicas: {published}")
    return run


def learn(
    env: CommonsEnv,
    policy: AgentPolicies,
    network: MLPNetwork,
    explore: EGreedyModule,
    loss: DQNLoss,
    buffer: TensorDictReplayBuffer,
    settings: DQNSettings,
    episodes: int,
    *,
    callbacks: Sequence[Callback],
) -> None:
    """One update a turn, as Mnih et al. (2015) do it; the target network is replaced as episodes end."""
    adam = torch.optim.Adam(loss.parameters(), lr=settings.learning_rate, eps=settings.adam_eps, fused=True)
    # HardUpdate copies at every (interval + 1)-th step, and once when it is made.
    target = HardUpdate(loss, value_network_update_interval=settings.target_every_episodes - 1)
    tracker = EpisodeTracker(1, env.game.agents)
    observer = Observer(callbacks, env)
    losses = []
    for step, turn in enumerate(StepCollector(env, policy), start=1):
        buffer.extend(transitions_of(0, turn))
        explore.eps.fill_(settings.epsilon(step))
        if len(buffer) >= settings.learning_starts:
            error = loss(buffer.sample())["loss"]
            adam.zero_grad()
            error.backward()
            adam.step()
            losses.append(error.item())
        observer.on_step(turn)
        for episode in tracker.add(turn):
            with torch.no_grad():
                values = network(turn["next", "agents", "observation"][:, 0])
            learning = {
                "agent_0/loss": fmean(losses) if losses else nan,
                "agent_0/epsilon": settings.epsilon(step),
                "agent_0/q": values.max().item(),
            }
            losses.clear()
            target.step()
            observer.on_episode(episode, learning)
            if episode.episode + 1 == episodes:
                return


if __name__ == "__main__":
    with in_a_sentence("own_loop.py"):
        tyro.cli(main)
