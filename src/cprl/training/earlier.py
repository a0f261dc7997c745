"""Agents of earlier runs: those that play here, and those whose weights others start from."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from cprl.algorithms.base import Algorithm, TeamAlgorithm
from cprl.commons.game import Game
from cprl.commons.spaces import Spaces
from cprl.custom import Custom, made
from cprl.learners.lanes import lane_name
from cprl.networks.agent import acting_part
from cprl.population import Frozen, Learning, Team, refuse_sharing
from cprl.training.stored import LoadedRun, load
from cprl.training.stored_agents import StoredAgent


def frozen_agents(
    specs: Iterable[Frozen],
    spaces: Spaces,
    game: Game | None,
    allow: Sequence[str],
    replicas: Sequence[int],
    weights: Mapping[str, str],
) -> dict[Frozen, list[StoredAgent]]:
    """The stored agent of each replica, by specification; each run is read once.

    Args:
        specs: the specifications.
        spaces: what agents observe and may do here.
        game: the game, if it is one of cprl's.
        allow: what the stored runs may import.
        replicas: the numbers of the replicas.
        weights: the names of the weights, by run; of others the final ones.

    Raises:
        ValueError: where it was trained for other observations, actions or ballots, or is not kept.
    """
    specs = tuple(specs)
    runs = {
        path: _fitting_run(path, spaces, game, allow, weights=weights.get(path), is_to_decide=True)
        for path in dict.fromkeys(spec.run for spec in specs)
    }
    return {
        spec: [runs[spec.run].agent(spec.agent, replica=spec.replica_for(replica)) for replica in replicas]
        for spec in specs
    }


def _fitting_run(
    path: str,
    spaces: Spaces,
    game: Game | None,
    allow: Sequence[str],
    *,
    weights: str | None = None,
    is_to_decide: bool = False,
) -> LoadedRun:
    """The stored run, refused where it was trained for other observations or actions, or other ballots if its
    agents are to decide here."""
    run = load(path, weights=weights, allow=allow)
    theirs = run.spaces
    differences: list[tuple[str, Any, Any]] = [
        ("observations", theirs.observation_shape, spaces.observation_shape),
        ("observations of the dtype", theirs.observation_dtype, spaces.observation_dtype),
        ("a number of actions of", theirs.actions, spaces.actions),
    ]
    if game is not None and isinstance(run.game, Game):
        if is_to_decide and game.ballots:
            differences.append(("ballots", _asked(run.game), _asked(game)))
        differences += [
            ("a form of observation", run.game.observation, game.observation),
            ("actions", run.game.actions, game.actions),
            ("channels", run.game.channels, game.channels),
            ("institutions that show", run.game.entries_shown, game.entries_shown),
        ]
    for name, came, here in differences:
        if came != here:
            raise ValueError(f"the agents of {path} have {name} {came}; this game has {here}")
    return run


def _asked(game: Game) -> list[tuple[str, tuple[float, ...]]]:
    """What agents of a game decide on, and the choices."""
    return [(ballot.title, ballot.choices) for ballot in game.ballots]


def start_weights(
    spec: Learning | Team,
    agents: tuple[int, ...],
    spaces: Spaces,
    game: Game | None,
    replicas: Sequence[int],
    allow: Sequence[str] = (),
) -> dict[str, dict[str, Tensor]]:
    """The state dict of the acting network with which each agent of each replica starts, by the lane's name;
    empty where they start anew.

    Args:
        spec: how the agents are specified.
        agents: their indices.
        spaces: what they observe and may do.
        game: the game, if it is one of cprl's.
        replicas: the numbers of the replicas.
        allow: what the stored run may import.

    Raises:
        ValueError: where the stored run has no such agent, or its network is another one; says how.
    """
    source = spec.start_from
    if source is None:
        return {}
    run, algorithm = _fitting_run(source.run, spaces, game, allow), algorithm_of(spec)
    theirs = _members(run, source, len(agents)) if isinstance(spec, Team) else (source.agent,) * len(agents)
    weights = {}
    for replica in replicas:
        for agent, stored_agent in zip(agents, theirs, strict=True):
            taken = source.replica_for(replica)
            where = f"{lane_name(taken, stored_agent)} of {source.run}"
            stored = run.agent(stored_agent, replica=taken)
            weights[lane_name(replica, agent)] = _weights(stored, algorithm, spaces, where)
    return weights


def _members(run: LoadedRun, source: Frozen, size: int) -> tuple[int, ...]:
    """The agents of the team that the stored agent is in."""
    theirs = run.specs[source.agent] if source.agent < len(run.specs) else None
    if not isinstance(theirs, Team) or len(theirs.agents) != size:
        what = f"in a team of {len(theirs.agents)}" if isinstance(theirs, Team) else "in no team"
        raise ValueError(
            f"agent {source.agent} of {source.run} is {what}; allowed for a team of {size} to start from: a "
            f"member of a team of {size}"
        )
    return theirs.agents


def _weights(stored: StoredAgent, algorithm: Algorithm, spaces: Spaces, where: str) -> dict[str, Tensor]:
    """The weights of a stored agent's network, if the algorithm's network computes the same with them."""
    name = type(algorithm).__name__
    if stored.network is None:
        raise ValueError(f"{where} is scripted, without weights; allowed: an agent that learned")
    if stored.kind[1] != algorithm.stochastic:
        kinds = {True: "the logits of a policy", False: "action values"}
        raise ValueError(
            f"the network of {where} outputs {kinds[stored.kind[1]]}; {name} learns "
            f"{kinds[algorithm.stochastic]}"
        )
    weights = stored.network.state_dict()
    with torch.random.fork_rng(devices=[]), torch.no_grad():
        network = acting_part(algorithm.make_network(spaces))
        try:
            network.load_state_dict(weights)
        except RuntimeError as error:
            reason = " ".join(str(error).split())
            raise ValueError(f"{where} has another network than {name} here: {reason}") from error
        torch.manual_seed(0)
        seen = torch.rand(8, *spaces.observation_shape) * spaces.observation_scale
        seen = seen.to(getattr(torch, spaces.observation_dtype))
        if not torch.equal(network(seen), stored.network(seen)):
            raise ValueError(
                f"{where} has another network than {name} here: with the same weights the outputs differ"
            )
    return weights


def algorithm_of(spec: Learning | Team) -> Algorithm:
    """The algorithm of a specification; refuses code of the user's own that is none."""
    is_sharing = isinstance(spec, Team) and spec.share_parameters
    wanted = TeamAlgorithm if isinstance(spec, Team) and not is_sharing else Algorithm
    algorithm = made(spec.algorithm)
    if not isinstance(algorithm, wanted):
        named = f" of {spec.algorithm.target}" if isinstance(spec.algorithm, Custom) else ""
        raise ValueError(
            f"the algorithm{named} is a {type(algorithm).__name__}; allowed: a subclass of "
            f"cprl.algorithms.{wanted.__name__}"
        )
    refuse_sharing(algorithm, is_sharing)
    return algorithm
