"""Converts recipes that are older than `Experiment` to the current format.

They hold the arguments of a recipe's function, in three generations: a "learner" alone; a population with the
agent indices of "learning" and "random"; and a population that lists a member for each agent.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Final

_REWARDS: Final = {"own": "individual", "group": "team"}
_OF_TEAMS: Final = ("VDN", "QMIX", "MAPPO", "IPPO")
"""Algorithms whose equal members formed a team."""


def experiment_config(recipe: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of the current `Experiment`, from an old recipe.

    Raises:
        KeyError: if the recipe lacks a field that every old recipe had.
    """
    arguments = recipe["arguments"]
    game = arguments["game"]
    return {
        "name": recipe["recipe"],
        "game": {
            "kind": "Game",
            "map": {"kind": "Map", **game["map"]},
            "rules": {"kind": "Rules", **game["rules"]},
            "observation": {"kind": "Observation", **game.get("observation", {})},
        },
        "agents": _agents(arguments, agents=len(game["map"]["starts"])),
        "episodes": arguments["episodes"],
        "replicas": arguments.get("replicas", 1),
        "seed": arguments.get("seed", 0),
        "update_every": arguments.get("learn_every", 1),
    }


def _agents(arguments: Mapping[str, Any], *, agents: int) -> list[dict[str, Any]]:
    population = arguments.get("population", {})
    if isinstance(population, list):
        return _specs(population)
    at_random = population.get("random", ())
    learner = {
        "kind": "Learning",
        "algorithm": {"kind": "DQN", "settings": _settings({"kind": "DQNSettings", **arguments["learner"]})},
    }
    scripted = {"kind": "Scripted", "policy": "random"}
    return [scripted if agent in at_random else learner for agent in range(agents)]


def _specs(members: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The specifications of the members; equal members that learned as a team become one."""
    specs = []
    for agent, member in enumerate(members):
        if member["member"] == "Learner" and member["algorithm"] in _OF_TEAMS:
            if member not in members[:agent]:
                team = [other for other, own in enumerate(members) if own == member]
                specs.append({**_learning(member), "kind": "Team", "agents": team})
        elif member["member"] == "Learner":
            specs.append(_learning(member))
        elif member["member"] == "Scripted":
            specs.append({"kind": "Scripted", "policy": member["manner"]})
        else:
            specs.append({"kind": "Frozen", **{name: member[name] for name in ("run", "agent", "replica")}})
    return specs


def _learning(member: Mapping[str, Any]) -> dict[str, Any]:
    rest = {name: own for name, own in member.items() if name not in ("member", "paid", "algorithm")}
    algorithm = {"kind": member["algorithm"], **rest, "settings": _settings(member["settings"])}
    return {"kind": "Learning", "algorithm": algorithm, "reward": _REWARDS[member.get("paid", "own")]}


def _settings(table: Mapping[str, Any]) -> dict[str, Any]:
    """The settings without prioritised replay, which no run used."""
    return {name: own for name, own in table.items() if (name, own) != ("priority_alpha", 0.0)}
