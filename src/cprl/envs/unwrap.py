"""Find the environment under its transforms, and read the number and names of agents and actions from it."""

from torchrl.envs import EnvBase, TransformedEnv

from cprl import keys
from cprl.commons.game import Game
from cprl.envs.commons_env import CommonsEnv


def base_env(env: EnvBase) -> EnvBase:
    """Return the environment that lies under all transforms."""
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env


def commons_of(env: EnvBase) -> CommonsEnv | None:
    """Return the `CommonsEnv` under the transforms, or None for an environment of another game."""
    base = base_env(env)
    return base if isinstance(base, CommonsEnv) else None


def commons_game_of(env: EnvBase) -> Game | None:
    """Return the `cprl.Game` that an environment plays, or None for another game."""
    commons = commons_of(env)
    return None if commons is None else commons.game


def clock_of(env: EnvBase) -> int | None:
    """Return the largest number of turns in an episode of an environment; None for a game without limit."""
    return clock_in(getattr(base_env(env), "game", None))


def clock_in(game: object) -> int | None:
    """Return the largest number of turns in an episode of a game; None for a game that states no limit."""
    return getattr(getattr(game, "rules", None), "episode_steps", None)


def agent_count(env: EnvBase) -> int:
    """Return the number of agents N, read from the shape of ("agents", "reward"), [B, N, 1].

    Raises:
        ValueError: if the batch size is not [B], or the reward is missing or has another shape.
    """
    size = tuple(env.batch_size)
    if len(size) != 1:
        raise ValueError(f"the environment has batch size {list(size)}; allowed: [B], B worlds")
    reward = env.full_reward_spec.get(keys.REWARD, None)
    shape = None if reward is None else tuple(reward.shape)
    if shape is None or len(shape) != 3 or shape[::2] != (*size, 1):
        actual_shape = None if shape is None else list(shape)
        raise ValueError(f'("agents", "reward") is {actual_shape}; allowed: [{size[0]}, N, 1]')
    return int(shape[1])


def agent_names(env: EnvBase) -> tuple[str, ...]:
    """Return the names of the agents: those in the environment's group "agents", otherwise agent_0, agent_1,
    and so on."""
    groups = getattr(base_env(env), "group_map", None)
    if isinstance(groups, dict) and keys.AGENTS in groups:
        return tuple(groups[keys.AGENTS])
    return tuple(f"agent_{agent}" for agent in range(agent_count(env)))


def action_count(env: EnvBase) -> int:
    """Return the number of actions A of each agent."""
    return int(env.full_action_spec[keys.ACTION].n)


def joint_actions(env: EnvBase) -> tuple[str, ...]:
    """Return the names of the joint actions, the environment's attribute `joint_actions`; () without it.

    Raises:
        ValueError: if the number of names is not A**N, one for each joint action.
    """
    listed = getattr(base_env(env), "joint_actions", ())
    names = tuple(listed) if isinstance(listed, tuple | list) else ()
    if names and len(names) != action_count(env) ** agent_count(env):
        raise ValueError(
            f"joint_actions of the environment has {len(names)} names; allowed: one for each of "
            f"{action_count(env)} ** {agent_count(env)} joint actions"
        )
    return names
