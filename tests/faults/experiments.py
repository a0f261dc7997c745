"""Four small trainings that faults are tried on; each takes a few seconds."""

from typing import Final

from cprl import Experiment, Game, Rules, maps
from cprl.algorithms import DQN, PPO, VDN, DQNSettings, RolloutSettings, Tabular, TabularSettings
from cprl.population import AgentSpec, Learning, Scripted, Team

RULES: Final = Rules(
    regrow_prob=(0.0, 0.2), window_rows=3, window_columns=5, episode_steps=25, freeze_steps=2
)
FOR_TWO: Final = Game(map=maps.parse(".A>.A\n.A.A.\n..<.A"), rules=RULES)
FOR_FOUR: Final = Game(map=maps.parse(".A>.A.\n.A.A.v\n..<.A.\n^A...A"), rules=RULES)

REPLAY: Final = DQNSettings(
    buffer_size=300,
    batch_size=4,
    learning_rate=1e-3,
    hidden_cells=(8,),
    epsilon_hold_steps=20,
    epsilon_decay_steps=1000,
    target_every_episodes=2,
)
ROLLOUTS: Final = RolloutSettings(
    rollout_steps=40, epochs=2, minibatch_size=20, learning_rate=1e-3, hidden_cells=(8,)
)
TABLE: Final = TabularSettings(epsilon_hold_steps=20, epsilon_decay_steps=1000)

AGENTS: Final[dict[str, tuple[AgentSpec, ...]]] = {
    "dqn": (Learning(DQN(settings=REPLAY)),) * 2,
    "mixed": (
        Learning(DQN(settings=REPLAY)),
        Learning(PPO(settings=ROLLOUTS)),
        Learning(Tabular(settings=TABLE)),
        Scripted("greedy"),
    ),
    "ppo": (Learning(PPO(settings=ROLLOUTS)),) * 2,
    "vdn": (Team(VDN(settings=REPLAY), agents=(0, 1)),),
}
"""Who plays in each training."""

EPISODES: Final = {"dqn": 40, "mixed": 30, "ppo": 80, "vdn": 40}
ENGINES: Final = ("eager", "compiled")


def experiment(name: str, engine: str = "eager") -> Experiment:
    """One of the trainings in `AGENTS`, of two replicas."""
    agents = AGENTS[name]
    return Experiment(
        name=name,
        game=FOR_FOUR if len(agents) == 4 else FOR_TWO,
        agents=agents,
        episodes=EPISODES[name],
        replicas=2,
        seed=3,
        evaluation_episodes=4,
        engine=engine,
    )
