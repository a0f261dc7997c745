"""Valid values and live objects that cases are made of: games, environments, networks, episodes, runs."""

import inspect
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Final, get_type_hints

import numpy as np
import torch
from hypothesis import strategies as st
from rich.console import Console
from torch import nn
from torchrl.envs import EnvBase
from torchrl.record.loggers import CSVLogger, Logger

from cprl import CommonsEnv, Custom, Experiment, Game, Map, Observation, Rules, maps, presets
from cprl.algorithms import (
    A2C,
    CQL,
    DQN,
    IPPO,
    IQL,
    LOLA,
    MADDPG,
    MAPPO,
    PPO,
    PR2,
    QMIX,
    SAC,
    VDN,
    Algorithm,
    DistributionalDQN,
    DQNSettings,
    LOLASettings,
    Reinforce,
    RolloutSettings,
    Tabular,
    TabularSettings,
    TeamAlgorithm,
)
from cprl.envs import make_env
from cprl.envs.matrix import MatrixGame, matching_pennies, prisoners_dilemma
from cprl.envs.taking import TakingGame
from cprl.institutions import (
    Boundaries,
    ClosedPatches,
    ClosedSeason,
    GraduatedSanctions,
    Levies,
    Mediation,
    Monitoring,
    Quota,
    Sanctioner,
    Tax,
    Vote,
)
from cprl.learners.base import Learner
from cprl.learners.decisions import Bandit
from cprl.measuring import Episode
from cprl.measuring.evaluate import evaluate
from cprl.networks import GRU, LSTM, MLP, Conv, MLPNetwork
from cprl.policies.assignment import AgentPolicies
from cprl.policies.lanes import random_agents
from cprl.population import Frozen, Learning, Scripted, Team
from cprl.preferences import Exchange, InequityAversion, SocialValueOrientation
from cprl.spaces import Spaces
from cprl.theory import CallableWorth, PayoffTable, PowerWorth, SharingGame, appropriation, herders

MEADOW: Final = Game(
    map=maps.parse(".A>.A\nA.A.A\n..<.A"),
    rules=Rules(regrow_prob=(0.0, 0.2), window_rows=3, window_columns=5, episode_steps=6, freeze_steps=2),
)
"""Small, never square; two agents, episodes of six turns."""
GOVERNED: Final = replace(MEADOW, institutions=(Quota(fine=1.0), Monitoring(), Vote(on=Tax())))
"""With rules that people make."""
ALONE: Final = Game(
    map=maps.parse(".A>.\nA.A."),
    rules=Rules(may_fire=False, window_rows=3, window_columns=3, episode_steps=5),
)
"""For one agent."""
REPLAY: Final = DQNSettings(
    buffer_size=40, batch_size=4, learning_starts=4, hidden_cells=(4,), epsilon_decay_steps=20
)
ROLLOUTS: Final = RolloutSettings(rollout_steps=4, minibatch_size=2, epochs=1, hidden_cells=(4,))
LOOKS: Final = LOLASettings(rollout_steps=2, critic_epochs=1, hidden_cells=(4,))
TABLES: Final = TabularSettings(epsilon_decay_steps=20, max_states=500)
DQN_AGENT: Final = Learning(DQN(settings=REPLAY))
EXPERIMENT: Final = Experiment(
    name="fuzz",
    game=MEADOW,
    agents=(DQN_AGENT, Scripted("greedy")),
    episodes=2,
    replicas=2,
    evaluation_episodes=1,
    engine="eager",
)
TEAM: Final = Team(VDN(settings=REPLAY), agents=(0, 1))

EXAMPLES: Final[dict[type, tuple[Any, ...]]] = {
    Map: (MEADOW.map, ALONE.map, maps.named("commons"), maps.rooms()),
    Rules: (
        *(Rules(), MEADOW.rules, ALONE.rules, presets.game("commons", variant="as_run").rules),
        presets.game("two_complex", variant="as_run_10_april").rules,
    ),
    Observation: (
        Observation(),
        Observation(area="full", encoding="one_hot"),
        Observation(agents_apart=True, scoreboard=True, stock_gauge=True),
    ),
    Game: (MEADOW, ALONE, GOVERNED, presets.game("single_basic")),
    MatrixGame: (prisoners_dilemma(), matching_pennies(turns=4, continue_prob=0.5, memory=2)),
    PowerWorth: (PowerWorth(), PowerWorth(top=23.0, factor=0.25, power=1.0)),
    CallableWorth: (CallableWorth(function=lambda total: 8 - total**3, most=2),),
    SharingGame: (herders(2), appropriation()),
    TakingGame: (
        *(TakingGame(herders(2)), TakingGame(appropriation(), turns=4, memory=2, continue_prob=0.5)),
        TakingGame(herders(3), levels=4, most=1.5),
    ),
    Boundaries: (Boundaries.strips(height=3, width=5, agents=2, step_fine=0.5),),
    Quota: (Quota(), Quota(share=0.5, window_steps=3, by_stock=True, fine=1.0)),
    ClosedSeason: (ClosedSeason(), ClosedSeason(period_steps=4, closed_steps=2, fine=0.0)),
    ClosedPatches: (ClosedPatches(below=3),),
    Tax: (Tax(), Tax(brackets=((0, 0.1), (2, 0.5)), period_steps=3, redistribution="none")),
    Levies: (Levies(groups=((0,), (1,))),),
    Vote: (Vote(on=Tax()), Vote(on=Quota(), override_prob=0.5)),
    Monitoring: (Monitoring(), Monitoring(prob=0.2, cost=0.5, monitor="elected")),
    GraduatedSanctions: (GraduatedSanctions(), GraduatedSanctions(freeze_steps=((1,), (2,)), on="tags")),
    Mediation: (Mediation(observed=False),),
    Sanctioner: (Sanctioner(), Sanctioner(agents=(1,))),
    DQNSettings: (DQNSettings(), REPLAY),
    RolloutSettings: (RolloutSettings(), ROLLOUTS),
    LOLASettings: (LOLASettings(), LOOKS),
    TabularSettings: (TabularSettings(), TABLES),
    MLP: (MLP(), MLP(hidden_cells=(4,))),
    Conv: (Conv(), Conv(channels=(2,), kernel_cells=3, hidden_cells=(4,))),
    GRU: (GRU(), GRU(encoder=MLP(hidden_cells=(4,)), recurrent_cells=3)),
    LSTM: (LSTM(), LSTM(encoder=MLP(hidden_cells=(4,)), recurrent_cells=3)),
    Custom: (Custom("torchrl.envs.transforms:RewardScaling", arguments={"loc": 0.0, "scale": 2.0}),),
    DQN: (
        DQN(settings=REPLAY),
        DQN(settings=REPLAY, double=True, network=MLP(hidden_cells=(3,))),
        DQN(settings=replace(REPLAY, optimizer="keras_rmsprop"), loss_function="log_cosh"),
    ),
    DistributionalDQN: (DistributionalDQN(settings=REPLAY, atoms=5),),
    CQL: (CQL(settings=REPLAY),),
    SAC: (SAC(settings=REPLAY),),
    PR2: (PR2(settings=REPLAY, temperature=0.5, entropy_bonus=False),),
    IQL: (IQL(settings=REPLAY),),
    PPO: (PPO(settings=ROLLOUTS),),
    A2C: (A2C(settings=ROLLOUTS),),
    Reinforce: (Reinforce(settings=ROLLOUTS),),
    Tabular: (Tabular(settings=TABLES),),
    VDN: (VDN(settings=REPLAY),),
    QMIX: (QMIX(settings=REPLAY, mixing_cells=3),),
    MADDPG: (MADDPG(settings=REPLAY, logit_penalty=0.0),),
    MAPPO: (MAPPO(settings=ROLLOUTS),),
    IPPO: (IPPO(settings=ROLLOUTS),),
    LOLA: (LOLA(settings=LOOKS), LOLA(settings=LOOKS, estimator="dice")),
    Bandit: (Bandit(), Bandit(step_size=0.5, epsilon_end=0.0)),
    InequityAversion: (InequityAversion(alpha=5, beta=0.05, smoothing=0.9),),
    SocialValueOrientation: (SocialValueOrientation(angle=0.5, weight=1.0),),
    Exchange: (Exchange(0.5),),
    Learning: (
        DQN_AGENT,
        Learning(PPO(settings=ROLLOUTS), reward="team"),
        Learning(PPO(settings=ROLLOUTS), reward=Exchange(0.25)),
    ),
    Team: (TEAM, Team(IPPO(settings=ROLLOUTS), agents=(0, 1), reward="individual")),
    Scripted: (Scripted(), Scripted("greedy")),
    Frozen: (Frozen("runs/none", agent=0),),
    Experiment: (
        EXPERIMENT,
        replace(EXPERIMENT, agents=(TEAM,)),
        replace(EXPERIMENT, game=ALONE, agents=(Learning(Tabular(settings=TABLES)),)),
    ),
    Spaces: (MEADOW.spaces, ALONE.spaces),
}
"""Valid values by their class; those of a base class are those of its subclasses."""


def echo(*arguments: Any, **named: Any) -> Any:
    """A function that takes anything."""
    return arguments[0] if arguments else None


def tiny_network() -> MLPNetwork:
    """The network of an agent on `MEADOW`."""
    return MLPNetwork(MEADOW.observation_shape, len(MEADOW.actions), hidden_cells=(4,))


def random_policy(worlds: int = 2) -> AgentPolicies:
    """Both agents of `MEADOW` at random."""
    return AgentPolicies(random_agents(MEADOW.spaces, (0, 1), replicas=worlds, seed=0))


@cache
def episodes() -> tuple[Episode, ...]:
    """Two episodes on `MEADOW`."""
    return tuple(evaluate(CommonsEnv(MEADOW, 2, seed=0), random_policy(), explore=True))


def learner(agents: tuple[int, ...] = (0, 1), replicas: int = 2) -> Learner:
    """Of agents on `MEADOW`."""
    return DQN(settings=REPLAY).make_learner(
        MEADOW.spaces, agents=agents, engine="eager", replicas=replicas, seed=0
    )


_MAKERS: Final[dict[type, tuple[Callable[[], Any], ...]]] = {
    EnvBase: (
        lambda: CommonsEnv(MEADOW, 2, seed=1),
        lambda: CommonsEnv(ALONE, 1, seed=1),
        lambda: make_env(MEADOW, worlds=2, transforms=EXAMPLES[Custom]),
    ),
    CommonsEnv: (lambda: CommonsEnv(MEADOW, 2, seed=1), lambda: CommonsEnv(ALONE, 1, seed=1)),
    nn.Module: (tiny_network, lambda: nn.Linear(2, 3), random_policy),
    Logger: (lambda: CSVLogger("fuzz", log_dir="logs"),),
    Console: (lambda: Console(quiet=True),),
    PayoffTable: (
        lambda: PayoffTable.of_pairs([[3, 0], [5, 1]]),
        lambda: PayoffTable.of_pairs([[0, -1, 1], [1, 0, -1], [-1, 1, 0]]),
        lambda: PayoffTable(agents=3, payoffs=np.arange(8.0).reshape(4, 2)),
    ),
    Path: (lambda: Path("somewhere"), lambda: Path("some/where.pt")),
    Episode: (lambda: episodes()[0], lambda: episodes()[1]),
    torch.Tensor: (lambda: torch.zeros(6, 2), lambda: torch.ones(1, 6, 2), lambda: torch.rand(2, 6, 2)),
    torch.device: (lambda: torch.device("cpu"),),
}
"""Makers of live objects by the class that a hint says."""


def examples_of(kind: type) -> st.SearchStrategy[Any] | None:
    """Examples of a class: some as they are, some with a field of another valid value; None where there are
    none."""
    if kind in _MAKERS:
        return st.sampled_from(_MAKERS[kind]).map(lambda make: make())
    if kind in (Algorithm, TeamAlgorithm):
        found = [own for of, values in EXAMPLES.items() if issubclass(of, kind) for own in values]
        return st.sampled_from(found)
    if kind in EXAMPLES:
        return st.one_of(st.sampled_from(EXAMPLES[kind]), varied(kind))
    found_here = [own for values in EXAMPLES.values() for own in values if _is_a(own, kind)]
    return st.sampled_from(found_here) if found_here else None


def _is_a(value: Any, kind: type) -> bool:
    try:
        return isinstance(value, kind)
    except TypeError:
        return False


@st.composite
def varied(draw: Any, kind: type) -> Any:
    """An example with one field of another valid value; the example itself where that does not fit."""
    example = draw(st.sampled_from(EXAMPLES[kind]))
    if not is_dataclass(example):
        return example
    name = draw(st.sampled_from([own.name for own in fields(example) if own.init]))
    value = draw(fields_of(kind)[name])
    try:
        return replace(example, **{name: value})
    except ValueError:
        return example


@cache
def fields_of(kind: type) -> dict[str, st.SearchStrategy[Any]]:
    """Valid values of each field of a dataclass."""
    from .hints import of_hint

    hints = get_type_hints(kind)
    return {
        own.name: st.one_of(
            st.sampled_from([getattr(example, own.name) for example in EXAMPLES[kind]]),
            of_hint(hints[own.name]),
        )
        for own in fields(kind)
        if own.init
    }


def arrays() -> st.SearchStrategy[Any]:
    """Small arrays of numbers."""
    shapes = st.sampled_from(((3,), (2, 3), (1, 400), (0,)))
    return st.tuples(shapes, st.integers(0, 9)).map(lambda own: np.random.default_rng(own[1]).random(own[0]))


def is_public_class(value: Any) -> bool:
    """Whether a constructor is fuzzed, not a function."""
    return inspect.isclass(value)
