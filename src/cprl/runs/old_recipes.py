"""Converts recipes that are older than `Experiment` to the current format.

They hold the arguments of a recipe's function, in three generations: a "learner" alone; a population with the
agent indices of "learning" and "random"; and a population that lists a member for each agent.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Final

from cprl.institutions.boundaries import NOBODY, OPEN

_REWARDS: Final = {"own": "individual", "group": "team"}
_OF_TEAMS: Final = ("VDN", "QMIX", "MAPPO", "IPPO")
"""Algorithms whose equal members formed a team."""


def experiment_config(recipe: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of the current `Experiment`, from an old recipe.

    Raises:
        KeyError: if the recipe lacks a field that every old recipe had.
    """
    arguments = recipe["arguments"]
    game = upgraded_game(arguments["game"])
    return {
        "name": recipe["recipe"],
        "game": {
            "kind": "Game",
            "map": {"kind": "Map", **game["map"]},
            "rules": {"kind": "Rules", **game["rules"]},
            "observation": {"kind": "Observation", **game.get("observation", {})},
            "institutions": game.get("institutions", []),
        },
        "agents": _agents(arguments, agents=len(game["map"]["starts"])),
        "episodes": arguments["episodes"],
        "replicas": arguments.get("replicas", 1),
        "seed": arguments.get("seed", 0),
        "update_every": arguments.get("learn_every", 1),
    }


def has_old_rules(game: object) -> bool:
    """Whether the rules of a game have a field that is an institution now."""
    if not isinstance(game, Mapping) or game.get("kind") != "Game":
        return False
    rules = game.get("rules")
    if not isinstance(rules, Mapping) or not isinstance(game.get("map"), Mapping):
        return False
    return "may_bite" in rules or any(isinstance(rules.get(n), list) for n in ("may_fire", "freeze_steps"))


def upgraded_game(game: Mapping[str, Any]) -> dict[str, Any]:
    """The table of a game whose rules may have fields of before December 2026, which are institutions now:
    `may_bite`, and `may_fire` and `freeze_steps` by agent.

    Raises:
        KeyError, TypeError, ValueError: if the table holds no game.
    """
    rules = dict(game["rules"])
    may_bite, may_fire, freeze = rules.pop("may_bite", None), rules.get("may_fire"), rules.get("freeze_steps")
    found: list[dict[str, Any]] = []
    if may_bite is not None:
        found.append({"kind": "Boundaries", **_regions(game["map"], may_bite), "observed": False})
    if isinstance(may_fire, Sequence):
        rules["may_fire"] = any(may_fire)
        if rules["may_fire"] and not all(may_fire):
            agents = [agent for agent, may in enumerate(may_fire) if may]
            found.append({"kind": "Sanctioner", "agents": agents, "observed": False})
    if isinstance(freeze, Sequence):
        rules["freeze_steps"] = 25
    if isinstance(freeze, Sequence) and rules.get("may_fire", True):
        sanctions = {"freeze_steps": freeze, "fines": [0.0], "recovery_steps": None, "on": "tags"}
        found.append({"kind": "GraduatedSanctions", **sanctions, "observed": False})
    kept = {**game, "rules": rules}
    return {**kept, "institutions": [*found, *game.get("institutions", ())]} if found else kept


_SIGNS: Final = "".join(chr(code) for code in range(ord("0"), 2**14) if chr(code).isprintable())


def _regions(board: Mapping[str, Any], may_bite: Sequence[Sequence[bool]]) -> dict[str, Any]:
    """The regions and owners of `Boundaries` that say the same as a table: a row per agent, a column per
    site. Sites that the same agents may harvest are one region."""
    columns = list(zip(*may_bite, strict=True))
    signs = {column: _SIGNS[nth] for nth, column in enumerate(dict.fromkeys(columns)) if any(column)}
    signs |= {column: OPEN if all(column) else NOBODY for column in columns if len(set(column)) == 1}
    rows = [[OPEN] * board["width"] for _ in range(board["height"])]
    for (row, col), column in zip(board["sites"], columns, strict=True):
        rows[row][col] = signs[column]
    owners = [
        "".join(sign for column, sign in signs.items() if column[agent] and sign != OPEN)
        for agent in range(len(may_bite))
    ]
    return {"regions": ["".join(row) for row in rows], "owners": owners}


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
