"""Agents of every replica that act at random, by the numbers of the random play beside a training."""

from cprl.policies.actors import LaneActor
from cprl.policies.rng import Purpose, lane_seeds


def random_agents(spaces, agents, *, replicas, seed):
    seeds = lane_seeds(seed, replicas=range(replicas), agents=agents, purpose=Purpose.RANDOM_PLAY)
    return {agents: LaneActor(None, spaces.actions, seeds=seeds, agents=len(agents))}
