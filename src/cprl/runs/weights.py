"""Save and load what agents have learned: the weights of their networks, and states that belong to them."""

import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import torch
from torch import nn

from cprl.runs.checkpoints import CHECKPOINTS, checkpoints_in, read_checkpoint, read_tensors
from cprl.runs.episodes import read_episodes
from cprl.runs.files import LOCK_FILE, REPORT, checksum, holder_of, refuse_missing, write_listed
from cprl.runs.recipe import read_recipe, resume_command
from cprl.values import refusal

TRANSFORMS: Final = "transforms.pt"
"""The file in `checkpoints/` with the state of the environment's transforms."""
DECISIONS: Final = "decisions.pt"
"""The file in `checkpoints/` with the values of what agents decide, by the agent's name."""


def save_weights(run: Path, networks: Mapping[str, nn.Module], *, name: str = "final") -> Path:
    """Write the weights of each agent's network, by the agent's name, atomically into
    `checkpoints/<name>.pt` of a run, which `load_weights` reads.

    Raises:
        ValueError: for a name that is none of a file.
    """
    if not name or Path(name).name != name or "\0" in name:
        raise refusal("name", name, "the name of a file, without slashes and suffix")
    weights = {agent: network.state_dict() for agent, network in networks.items()}
    return _save(run, f"{name}.pt", weights)


def save_beside_weights(run: Path, name: str, state: Mapping[str, Any]) -> None:
    """Write the file `TRANSFORMS` or `DECISIONS` beside the weights, atomically; no file for an empty state.

    Args:
        state: for `DECISIONS` float64 [C] by the agent's name, see
            `cprl.policies.decisions.BanditDecider.learned`.
    """
    if state:
        _save(run, name, state)


def _save(run: Path, name: str, content: Mapping[str, Any]) -> Path:
    write_listed(Path(run), f"{CHECKPOINTS}/{name}", lambda file: torch.save(dict(content), file))
    return Path(run) / CHECKPOINTS / name


def load_weights(path: Path) -> dict[str, Any]:
    """Load the state of each agent's network, or of each transform, without running code of the file."""
    return read_tensors(path, "holds no weights")


class StoredWeights(NamedTuple):
    """The weights of a run's agents, and the states that belong to them."""

    path: Path
    """The file that held the weights."""
    networks: Mapping[str, Any]
    """The state dict of each acting network, by "replica_0/agent_0" and so on."""
    transforms: Mapping[str, Any]
    """The states of the environment's transforms."""
    decisions: Mapping[str, Any]
    """The values of each lane's decisions."""


def weights_in(run: Path, name: str | None) -> StoredWeights:
    """Load the weights of a run's agents, and the states that belong to them.

    Args:
        name: the name of a file in its `checkpoints/`, without ".pt"; None for the final weights, or those in
            the newest readable checkpoint of a run that has not ended.

    Raises:
        ValueError: if the run has no weights, or its files are damaged.
    """
    refuse_missing(run)
    folder = run / CHECKPOINTS
    path = folder / f"{name or 'final'}.pt"
    if name is None and not path.exists():
        return _weights_of_newest_checkpoint(run)
    return StoredWeights(
        path=path,
        networks=load_weights(path),
        transforms=_load_beside(path, TRANSFORMS),
        decisions=_load_beside(path, DECISIONS),
    )


def _load_beside(weights: Path, name: str) -> dict[str, Any]:
    """Load the file `TRANSFORMS` or `DECISIONS` that belongs to a file of weights; {} if there is none.

    A run that was extended keeps its earlier weights with a suffix, such as "final-4800.pt", and the states
    that belong to them with the same one: "transforms-4800.pt".
    """
    latest = weights.with_name(name)
    suffix = weights.stem.removeprefix("final") if weights.stem.startswith("final") else ""
    earlier = latest.with_stem(f"{latest.stem}{suffix}")
    for path in (earlier, latest):
        if path.exists():
            return load_weights(path)
    return {}


def lacks_weights(run: Path) -> bool:
    """Return whether a run has ended and keeps no weights, because it was exported without them.

    Raises:
        ValueError: if a file is missing that the manifest of the run lists.
    """
    if not (run / REPORT).exists() or (run / CHECKPOINTS / "final.pt").exists():
        return False
    refuse_missing(run)
    return True


def _weights_of_newest_checkpoint(run: Path) -> StoredWeights:
    """Load the weights in the newest readable checkpoint of a run that has not ended."""
    final = run / CHECKPOINTS / "final.pt"
    if lacks_weights(run):
        raise ValueError(
            f"{run} keeps no weights: its results were exported without them, or {final} was lost; allowed: "
            "the run itself, or an export with weights"
        )
    checkpoints = checkpoints_in(run / CHECKPOINTS)
    episodes = 0 if checkpoints else _count_episodes(run)
    if episodes:
        raise ValueError(
            f"{run} has {episodes} episodes, of all replicas together, and no checkpoint yet "
            f"({_describe_writer(run)}); read_episodes reads them, and all else works from the first "
            "checkpoint on"
        )
    reasons = [f"{final} is not there, nor a readable checkpoint: has {run} been trained?"]
    for checkpoint in reversed(checkpoints):
        try:
            return _weights_in_checkpoint(checkpoint)
        except (ValueError, KeyError) as error:
            reasons.append(str(error))
    raise ValueError("; ".join(reasons))


def _weights_in_checkpoint(checkpoint: Path) -> StoredWeights:
    """Take the weights, and the states that belong to them, from the state of a training."""
    state = read_checkpoint(checkpoint)
    networks: dict[str, Any] = {}
    for learner in state["learners"]:
        networks.update(learner["networks"])
    for other in state["others"]:
        networks.update(other.get("_extra_state", {}).get("networks", {}))
    decisions: Mapping[str, Any] = next(iter(state.get("decisions", ())), {})
    return StoredWeights(
        path=checkpoint,
        networks=networks,
        transforms=state.get("env", {}).get("transforms", {}),
        decisions=decisions.get("_extra_state", {}).get("learned", {}),
    )


def _count_episodes(run: Path) -> int:
    """Return the number of episodes in the table of a run, of all replicas together; 0 without a table."""
    try:
        agents = read_episodes(run)["agent"].to_numpy()
    except FileNotFoundError:
        return 0
    return int((agents == 0).sum())


def _describe_writer(run: Path) -> str:
    """Say who writes a run, or how it is resumed."""
    if (run / LOCK_FILE).exists():
        return f"{holder_of(run)} is writing it, or was killed"
    return f"nobody is writing it; to resume it: {resume_command(run)}"


# A frozen agent plays with the weights of another run, its partner. The recipe of the run in which it plays
# holds the checksum of these weights, so that they are found again after the partner was extended.

FROZEN_FIELD: Final = "frozen"
"""The field of `recipe.json` with the checksum of each partner's final weights, by the partner's path
relative to the run."""


def frozen_checksums(run: Path, partners: Iterable[str]) -> dict[str, dict[str, str]]:
    """Return what the recipe of a run says of its partners: the checksums of their final weights, under
    `FROZEN_FIELD`; {} if none of them has ended.

    Args:
        run: the directory of the run that begins.
        partners: the directories of the partners, see `cprl.population.partners_in`.
    """
    final = {os.path.relpath(partner, run): Path(partner) / CHECKPOINTS / "final.pt" for partner in partners}
    checksums = {partner: checksum(path) for partner, path in final.items() if path.exists()}
    return {FROZEN_FIELD: checksums} if checksums else {}


def frozen_weights_name(recipe: Mapping[str, Any], run: Path, partner: str) -> str | None:
    """Return the name of the partner's file of weights that plays in a run; None if the recipe names none.

    Raises:
        ValueError: if the partner no longer has these weights.
    """
    expected = (recipe.get(FROZEN_FIELD) or {}).get(os.path.relpath(partner, run))
    if expected is None:
        return None
    folder = Path(partner) / CHECKPOINTS
    for path in (folder / "final.pt", *sorted(folder.glob("final-*.pt"))):
        if path.exists() and checksum(path) == expected:
            return path.stem
    raise ValueError(
        f"{partner} no longer has the weights that play in {run} (a file with the checksum {expected} "
        f"in its {CHECKPOINTS}/); allowed: the run as it was, extended, or its export"
    )


def frozen_weights_names(run: Path, partners: Sequence[str]) -> dict[str, str]:
    """Return the name of each partner's file of weights that plays in a run, by partner; partners of which
    the recipe names none are left out."""
    recipe = read_recipe(run) if partners else {}
    names = {partner: frozen_weights_name(recipe, run, partner) for partner in partners}
    return {partner: name for partner, name in names.items() if name is not None}
