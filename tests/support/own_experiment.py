"""An experiment that names parts of a user's own: a network, transforms, a callback, a metric."""

from cprl import Custom, Experiment, Game, Rules, maps
from cprl.algorithms import DQN, DQNSettings
from cprl.networks import Conv
from cprl.population import Learning

REPLAY = DQNSettings(
    buffer_size=300,
    batch_size=4,
    learning_rate=1e-3,
    epsilon_hold_steps=10,
    epsilon_decay_steps=400,
    target_every_episodes=2,
)
MEADOW = Experiment(
    name="own",
    game=Game(
        map=maps.parse(".A>.A.A\nA.A...A\n..<.A.A"),
        rules=Rules(
            regrow_prob=(0.0, 0.2), window_rows=3, window_columns=5, episode_steps=20, freeze_steps=2
        ),
    ),
    agents=[Learning(DQN(settings=REPLAY, network=Conv(channels=(4,), hidden_cells=(8,))))] * 2,
    replicas=2,
    episodes=6,
    seed=3,
    evaluation_episodes=2,
    transforms=[
        Custom(
            "torchrl.envs.transforms:RewardScaling",
            arguments={"loc": 0.0, "scale": 0.5, "in_keys": [["agents", "reward"]]},
        ),
        Custom("own_parts:Fatigue", arguments={"per_step": 0.01}),
    ],
    callbacks=[Custom("own_parts:Bored", arguments={"from_episode": 7, "epsilon": 0.4})],
    metrics=[Custom("own_parts:largest_share")],
    engine="eager",
)
