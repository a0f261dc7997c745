"""How the arguments of some public names are drawn, where their hints do not say it."""

from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from hypothesis import strategies as st
from tensordict import TensorDict

import cprl
from cprl import CommonsEnv, maps, presets
from cprl.algorithms import DQN
from cprl.collectors import StepCollector
from cprl.envs import parallel_env
from cprl.envs.matrix import stag_hunt
from cprl.evaluation import schelling, territory_of
from cprl.measuring import phases
from cprl.policies.lanes import random_agents
from cprl.population import Scripted
from cprl.studies import InProcess

from . import hints, runs, things


def _chance() -> torch.Generator:
    return torch.Generator().manual_seed(0)


_FEW: Final = st.integers(1, 3)
_SEEDS: Final = st.sampled_from((0, 1, 7, 2**63, 2**64 - 2))
_RUNS: Final = st.one_of(st.sampled_from(runs.NAMES).map(runs.folder), hints.PATHS)
_TABLES: Final = st.one_of(
    st.sampled_from(("plain", "finished", "stopped")).map(
        lambda name: runs.folder(name) / "episodes.parquet"
    ),
    hints.PATHS,
)
_FINISHED: Final = st.one_of(*[st.sampled_from(("plain", "plain", "finished")).map(runs.folder)] * 4, _RUNS)
_ALLOW: Final = st.sampled_from((runs.ALLOW, runs.ALLOW, ()))
_FRESH: Final = {
    "run": _FINISHED,
    "episodes": _FEW,
    "seed": _SEEDS,
    "replicas": st.sampled_from(((), (0,), (1, 0))),
    "allow": _ALLOW,
}
_RESPONSES: Final = {
    **_FRESH,
    "agents": st.sampled_from(((0,), (1, 0), (2,), ())),
    "algorithms": st.sampled_from(((), ("own",), ("PPO", "DQN"), ("SAC",))),
    "seeds": st.integers(1, 2),
    "training_episodes": st.sampled_from((None, 1)),
    "replicas": st.sampled_from((None, 1, 3)),
    "device": st.just("cpu"),
}
_ENVS: Final = things.examples_of(CommonsEnv)
_BOARD: Final = st.sampled_from(presets.BOARDS)
_SHAPES: Final = st.sampled_from(((6, 2), (6, 2), (6, 2), (1, 1), (3, 6, 2), (0, 2)))
_HARVEST: Final = _SHAPES.map(lambda shape: (torch.rand(shape, generator=_chance()) < 0.5).float())
_IN_PLAY: Final = _SHAPES.map(lambda shape: torch.rand(shape, generator=_chance()) < 0.8)
_PLAYED: Final = _SHAPES.map(lambda shape: torch.ones(shape[:-1], dtype=torch.bool))
_SOCIAL: Final = {"harvest": _HARVEST, "in_play": _IN_PLAY, "played": st.one_of(st.none(), _PLAYED)}
_AMOUNTS: Final = st.one_of(st.floats(0, 100, allow_subnormal=False), st.just(3).map(torch.tensor))
_ARRAYS: Final = things.arrays()
_LONG: Final = st.sampled_from((1200, 1200, 1200, 900)).map(lambda number: np.arange(float(number)))
_CURVES: Final = st.integers(0, 9).map(
    lambda seed: {name: np.random.default_rng(seed).random((2, 1200)) for name in phases.METRICS}
)
_NETWORKS: Final = st.just(0).map(lambda _: {"agent_0": things.tiny_network()})
_LEARNER: Final[dict[str, st.SearchStrategy[Any]]] = {
    "spaces": st.just(things.MEADOW.spaces),
    "agents": st.sampled_from(((0,), (0, 1), [1])),
    "replicas": _FEW,
    "make_network": st.just(things.tiny_network),
}
_PHASES: Final = {"episodes": _LONG, "metrics": _CURVES, "number": st.integers(1, 2), "resamples": _FEW}


def _batch() -> TensorDict:
    env = CommonsEnv(things.MEADOW, 2, seed=0)
    return next(iter(StepCollector(env, things.random_policy())))


def _loss(network: Any) -> Any:
    return DQN(settings=things.REPLAY).make_loss(network)


def _ppo_loss(network: Any) -> Any:
    return things.EXAMPLES[cprl.algorithms.PPO][0].make_loss(network)


def _ppo_network() -> Any:
    return things.EXAMPLES[cprl.algorithms.PPO][0].make_network(things.MEADOW.spaces)


OWN: Final[dict[str, dict[str, st.SearchStrategy[Any]]]] = {
    "cprl.agents:Population": {
        "env": st.integers(1, 2).map(lambda worlds: CommonsEnv(things.MEADOW, worlds, seed=1)),
        "specs": st.sampled_from(
            (things.EXPERIMENT.agents, (things.TEAM,), (Scripted(), Scripted("greedy")))
        ),
        "engine": st.sampled_from(("eager", "torchrl")),
        "seed": _SEEDS,
    },
    "cprl.commandline:recipe_main": {
        "make_experiment": st.just(runs.experiment),
        "argv": st.sampled_from((["recipe.py", "--help"], ["recipe.py", "--number", "3"], ["recipe.py"])),
    },
    "cprl.collectors:StepCollector": {
        "env": _ENVS,
        "policy": st.just(0).map(lambda _: things.random_policy()),
    },
    "cprl.envs.commons_env:CommonsEnv": {
        "worlds": _FEW,
        "seed": _SEEDS,
        "device": hints.DEVICES,
        "threads": _FEW,
    },
    "cprl.envs.gymnasium_env:CommonsGymnasiumEnv": {
        "game": st.sampled_from((things.ALONE, presets.game("single_basic"))),
        "seed": _SEEDS,
        "render_mode": st.sampled_from((None, "rgb_array")),
    },
    "cprl.envs.pettingzoo_env:CommonsParallelEnv": {"seed": _SEEDS, "render_mode": st.just("rgb_array")},
    "cprl.envs.pettingzoo_env:parallel_env": {"seed": _SEEDS, "render_mode": st.just("rgb_array")},
    "cprl.envs.pettingzoo_env:env": {"seed": _SEEDS, "render_mode": st.just("rgb_array")},
    "cprl.envs.make_env:make_env": {
        "game": st.sampled_from((things.MEADOW, things.ALONE)),
        "worlds": _FEW,
        "seed": _SEEDS,
        "device": hints.DEVICES,
        "transforms": st.sampled_from(((), things.EXAMPLES[cprl.Custom])),
    },
    "cprl.commons.maps.drawings:parse": {
        "drawing": st.one_of(
            st.sampled_from((".A>", ".A>.\n#A.v", "A", ">A\nA")), st.text(".A#>v<^ \n", max_size=30)
        )
    },
    "cprl.commons.maps.drawings:named": {"name": st.sampled_from(maps.NAMES)},
    "cprl.commons.maps.generators:crosses": {
        "height": st.just(9),
        "width": st.just(12),
        "centres": st.sampled_from(([(2, 2)], [(2, 2), (6, 8)])),
        "starts": st.sampled_from(([(0, 0, 1)], [(0, 0, 1), (8, 8, 3)])),
        "walls": st.sampled_from(((), [(4, 4)])),
    },
    "cprl.commons.maps.generators:random": {
        "height": st.integers(2, 12),
        "width": st.integers(2, 12),
        "agents": _FEW,
        "density": st.floats(0, 0.5, allow_subnormal=False),
        "clustering": st.floats(0, 1, allow_subnormal=False),
        "seed": _SEEDS,
    },
    "cprl.config:from_config": {"table": st.one_of(st.sampled_from(runs.CONFIGS), hints.of_hint(Any))},
    "cprl.config:to_config": {
        "value": st.sampled_from([own for values in things.EXAMPLES.values() for own in values][:60])
    },
    "cprl.evaluation.cross_play:crossplay": {
        "runs": st.lists(_FINISHED, min_size=1, max_size=2),
        "episodes": _FEW,
        "seed": _SEEDS,
        "replicas": st.sampled_from(((), (0,), (1, 0))),
        "allow": _ALLOW,
    },
    "cprl.evaluation.empirical_game:play_empirical_game": {
        "runs": st.lists(_FINISHED, min_size=1, max_size=2),
        "episodes": _FEW,
        "seed": _SEEDS,
        "replicas": st.sampled_from(((), (0,), (1, 0))),
        "allow": _ALLOW,
    },
    "cprl.evaluation.evaluate:evaluate_run": _FRESH,
    "cprl.evaluation.populations:play_population": {
        "where": st.sampled_from((things.MEADOW, stag_hunt(turns=2))),
        "agents": st.sampled_from(([Scripted("random")] * 2, [Scripted("greedy"), Scripted("random")])),
        "episodes": _FEW,
        "replicas": _FEW,
        "seed": _SEEDS,
        "allow": _ALLOW,
    },
    "cprl.evaluation.responses:play_responses": {
        "run": _FINISHED,
        "responses": st.sampled_from((0, 0, 1, 2)).map(lambda own: {own: {"own": runs.folder("plain")}}),
        "episodes": _FEW,
        "replicas": st.sampled_from((None, 1, 3)),
        "seed": _SEEDS,
        "allow": _ALLOW,
    },
    "cprl.exploiting.exploit:exploitability": {
        **_RESPONSES,
        "out": st.sampled_from((None, "out", "some/out")),
        "on": st.sampled_from((None, InProcess())),
        "progress": st.booleans(),
    },
    "cprl.exploiting.plan:plan_responses": _RESPONSES,
    "cprl.evaluation.schelling:schelling": {
        "where": st.just(things.MEADOW),
        "restrained": st.sampled_from(("sustainable", "pacifist")),
        "greedy": st.sampled_from(("greedy", "random")),
        "episodes": _FEW,
        "replicas": _FEW,
        "seed": _SEEDS,
        "allow": _ALLOW,
    },
    "cprl.evaluation.schelling_picture:draw_schelling": {
        "found": st.just(0).map(lambda _: schelling(things.MEADOW, episodes=1, replicas=2)),
        "path": st.sampled_from(("diagram.png", "new/diagram.png", "diagram.gif")),
    },
    "cprl.evaluation.scenarios.suite:run_scenarios": {
        **_FRESH,
        "scenarios": st.sampled_from(((), ["minority_among_greedy"], ["minority_among_wolves"])),
    },
    "cprl.evaluation.territory:territory_of": _FRESH,
    "cprl.evaluation.visits_picture:draw_visits": {
        "found": st.just(0).map(lambda _: territory_of(runs.folder("plain"), episodes=1)),
        "path": st.sampled_from(("visits.png", "new/visits.png", "visits.gif")),
        "replica": st.sampled_from((None, 0, 7)),
    },
    "cprl.learners.torchrl.replay:TorchRLReplayLearner": {**_LEARNER, "make_loss": st.just(_loss)},
    "cprl.learners.torchrl.rollouts:TorchRLRolloutLearner": {
        **_LEARNER,
        "make_network": st.just(_ppo_network),
        "make_loss": st.just(_ppo_loss),
    },
    "cprl.learners.transitions:transitions_of": {
        "agent": st.integers(0, 1),
        "batch": st.just(0).map(lambda _: _batch()),
    },
    "cprl.measuring.evaluate:evaluate": {
        "env": st.just(2).map(lambda worlds: CommonsEnv(things.MEADOW, worlds, seed=1)),
        "policy": st.sampled_from((2, 2, 2, 1)).map(things.random_policy),
    },
    "cprl.measuring.episodes:EpisodeTracker": {"worlds": _FEW, "agents": _FEW},
    **{
        f"cprl.measuring.social:{name}": _SOCIAL
        for name in ("efficiency", "equality", "peace", "peacefulness")
    },
    **{f"cprl.measuring.social:{name}": _SOCIAL for name in ("collective_return", "survival_steps")},
    "cprl.measuring.social:sustainability": _SOCIAL,
    **{
        f"cprl.measuring.social:{name}": {**_SOCIAL, "sustainable_yield": _AMOUNTS, "first_stock": _AMOUNTS}
        for name in ("summary", "yield_share")
    },
    "cprl.measuring.phases:change_points": _PHASES,
    "cprl.measuring.phases:find_phases": _PHASES,
    "cprl.measuring.phases:phases": {**_PHASES, "changes": st.sampled_from(((300.0,), (300.0, 700.0), ()))},
    "cprl.measuring.statistics:curve_interval": {
        "curves": st.sampled_from(((1, 4), (3, 5))).map(np.ones),
        "confidence": st.sampled_from((0.5, 0.95)),
    },
    "cprl.measuring.statistics:estimate": {
        "strata": st.lists(_ARRAYS.filter(lambda own: own.ndim == 1), min_size=1, max_size=2),
        "resamples": _FEW,
        "seed": _SEEDS,
        "confidence": st.sampled_from((0.5, 0.95)),
    },
    "cprl.measuring.statistics:inter_quartile_mean": {"values": _ARRAYS, "axis": st.sampled_from((-1, 0))},
    "cprl.measuring.statistics:mean": {"values": _ARRAYS, "axis": st.sampled_from((-1, 0))},
    "cprl.networks.convolutional:ConvNetwork": {
        "observation_shape": st.sampled_from(((3, 6, 13), (8, 3, 5), [3, 3, 3])),
        "outputs": _FEW,
        "channels": st.sampled_from(((2,), (2, 2))),
        "kernel_cells": st.sampled_from((1, 3)),
    },
    "cprl.networks.mlp:MLPNetwork": {
        "observation_shape": st.sampled_from(((3, 6, 13), (8, 3, 5), [3])),
        "actions": _FEW,
    },
    "cprl.policies.assignment:AgentPolicies": {
        "actors": st.sampled_from((1, 2)).map(
            lambda worlds: random_agents(things.MEADOW.spaces, (0, 1), replicas=worlds, seed=0)
        )
    },
    "cprl.policies.single:RandomActor": {"actions": _FEW, "device": hints.DEVICES, "seed": _SEEDS},
    "cprl.presets:game": {"board": _BOARD},
    "cprl.presets:dqn_settings": {"board": _BOARD},
    "cprl.presets:gymnasium_env": {
        "board": st.sampled_from(("single_basic", "single_complex")),
        "seed": _SEEDS,
    },
    "cprl.process:prepare_process": {"seed": _SEEDS},
    "cprl.reporting.report:write_report": {
        "runs": st.lists(_FINISHED, min_size=1, max_size=2),
        "out": hints.PATHS,
        "allow": _ALLOW,
    },
    "cprl.preferences.wanted:wanted_rewards": {
        "rewards": st.sampled_from((np.ones((2, 3), np.float32), torch.zeros(1, 2), np.ones((2, 1)))),
        "smoothed": st.none() | st.just(0).map(lambda _: np.ones((2, 3))),
    },
    "cprl.preferences.wrapper:PreferenceWrapper": {
        "env": st.just(0).map(lambda _: parallel_env(things.MEADOW)),
    },
    "cprl.running:run": {
        "experiment": st.sampled_from(things.EXAMPLES[cprl.Experiment]),
        "out": hints.PATHS,
        "watch": st.just("off"),
        "resume": st.just(False),
        "command": st.sampled_from((None, ["recipe.py", "--seed", "3"])),
    },
    "cprl.runs.directory:start_run": {
        "out": hints.PATHS,
        "to_recipe": st.just(things.EXPERIMENT.to_recipe),
        "resume": st.just(False),
        "command": st.sampled_from((None, ["recipe.py", "--seed", "3"])),
    },
    "cprl.runs.episodes:read_episodes": {"run_directory": _RUNS},
    "cprl.runs.episodes:read_table": {"path": _TABLES},
    "cprl.runs.episodes:EpisodeTable": {"path": st.just(Path("episodes.parquet"))},
    "cprl.runs.export:export_results": {"run": _FINISHED, "folder": hints.PATHS},
    "cprl.runs.loggers:LoggerCallback": {"replicas": _FEW, "agents": st.sampled_from((None, ["a", "b"]))},
    "cprl.runs.weights:BestWeights": {
        "run": hints.PATHS,
        "networks": _NETWORKS,
        "policy": st.just(0).map(lambda _: things.random_policy()),
        "env": _ENVS,
        "every": _FEW,
        "logger": st.none(),
    },
    "cprl.runs.weights:restore_weights": {
        "path": st.sampled_from(("finished",)).map(
            lambda name: runs.folder(name) / "checkpoints" / "final.pt"
        ),
        "networks": st.sampled_from((2, 2, 2, 1)).map(
            lambda number: {f"replica_{own}/agent_0": things.tiny_network() for own in range(number)}
        ),
    },
    "cprl.runs.weights:save_decisions": {"run": st.just(Path("."))},
    "cprl.runs.weights:save_weights": {"run": st.just(Path(".")), "networks": _NETWORKS},
    "cprl.stored:load": {
        "run": _RUNS,
        "weights": st.sampled_from((None, "final", "final", "best")),
        "allow": _ALLOW,
    },
    "cprl.terminal.figures:training_curve": {
        "run": _FINISHED,
        "title": st.just("curve"),
        "random": st.one_of(st.none(), st.just(0).map(lambda _: list(things.episodes()))),
        "smoothed": st.integers(1, 100),
    },
    "cprl.terminal.progress:ProgressBar": {
        "game": st.just(things.MEADOW),
        "episodes": _FEW,
        "replicas": _FEW,
    },
    "cprl.terminal.summary:summarise": {
        "run": _RUNS,
        "played": st.just(0).map(lambda _: {"random": list(things.episodes())}),
    },
    "cprl.training:train": {
        "env": st.just(0).map(lambda _: CommonsEnv(things.MEADOW, 2, seed=1)),
        "learners": st.just(0).map(lambda _: {(0, 1): things.learner()}),
        "episodes": _FEW,
        "others": st.one_of(st.none(), st.just({})),
        "callbacks": st.just(()),
        "update_every": st.integers(1, 2),
        "make_collector": st.just(StepCollector),
        "checkpointer": st.none(),
    },
    "cprl.viewer.callback:ViewerCallback": {
        "run": st.just(Path(".")),
        "env": _ENVS,
        "episodes": _FEW,
        "live": st.none(),
        "file_name": st.sampled_from((None, "one.rrd")),
        "recipe": st.sampled_from((None, {"seed": 3})),
        "console": things.examples_of(things.Console),
    },
    "cprl.viewer.logger:RerunLogger": {
        "exp_name": st.just("fuzz"),
        "log_dir": hints.PATHS,
        "scene": st.none(),
        "curves": st.none(),
        "live": st.none(),
        "file_name": st.just("one.rrd"),
        "recording_id": st.sampled_from((None, "a")),
        "console": things.examples_of(things.Console),
    },
    "cprl.viewer.streams:check_watch": {"watch": st.sampled_from(("file", "off", "serve", "spawn"))},
}
"""How parameters are drawn, by public name."""
