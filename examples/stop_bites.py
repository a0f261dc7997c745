"""How to stop a bite by a rule of your own: a transform puts the apple back after the turn.
Prints how many apples are left on a board of greedy agents, for two limits."""

from functools import partial

from torchrl.envs import Transform

import cprl
from cprl import Game, Rules, maps
from cprl.population import Scripted
from cprl.runs.episodes import read_episodes


class Reserve(Transform):
    """Stops bites in turns that begin with at most `least` apples.

    Films do not show the bites and shots of such a turn; built-in institutions still count the bite.
    """

    def __init__(self, least=2):
        super().__init__()
        self.least = least

    def _step(self, tensordict, next_tensordict):
        env, agents = self.parent.base_env, next_tensordict["agents"]
        stopped = agents["harvest"] * (tensordict["stock"] <= self.least)
        if not stopped.any():
            return next_tensordict
        state, sites = env.worlds.state(), list(env.game.map.sites)
        for world, agent in stopped.nonzero().tolist():
            cell = state["row"][world, agent], state["col"][world, agent]
            state["stock"][world, sites.index(cell)] = 1
            state["harvested"][world, agent] -= 1
            is_over = state["step"][world] == env.game.rules.episode_steps
            state["ended"][world] = 2 if is_over else 0  # truncated, or playing on
        now = env.load(state)
        for name in ("stock", "done", "terminated", "truncated", ("agents", "observation")):
            next_tensordict[name] = now[name]
        agents["harvest"] = agents["harvest"] - stopped
        agents["reward"] = agents["reward"] - stopped.unsqueeze(-1)
        return next_tensordict


if __name__ == "__main__":  # so that other modules can import the class
    game = Game(map=maps.parse(".A>.A.\nAA..AA\n.A.<A."), rules=Rules(regrow_prob=(0.0,), episode_steps=50))
    for least in (0, 3):
        experiment = cprl.Experiment(
            name=f"reserve_{least}",
            game=game,
            agents=(Scripted("greedy"),) * 2,
            episodes=5,
            evaluation_episodes=1,
            transforms=(partial(Reserve, least=least),),
        )
        left = read_episodes(cprl.run(experiment, watch="off"))["stock_left"].to_pylist()
        print(f"a reserve of {least}: {min(left)} to {max(left)} apples are left")
