"""Saves and loads what agents have learned: the weights of their networks, and what goes with them."""

import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import torch
from torch import nn

from cprl.runs.checkpoints import FOLDER, checkpoints_in, read_checkpoint, read_tensors
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
    `checkpoints/<name>.pt` of a run, which `load_weights` reads."""
    if not name or Path(name).name != name or "\0" in name:
        raise refusal("name", name, "the name of a file, without slashes and suffix")
    weights = {agent: network.state_dict() for agent, network in networks.items()}
    return _save(run, f"{name}.pt", weights)


def save_beside_weights(run: Path, name: str, state: Mapping[str, Any]) -> None:
    """Write what goes with weights, `TRANSFORMS` or `DECISIONS`, atomically; no file where there is nothing.

    Args:
        state: of `DECISIONS` float64 [C] by the agent's name, see
            `cprl.policies.decisions.BanditDecider.learned`.
    """
    if state:
        _save(run, name, state)


def _save(run: Path, name: str, content: Mapping[str, Any]) -> Path:
    write_listed(Path(run), f"{FOLDER}/{name}", lambda file: torch.save(dict(content), file))
    return Path(run) / FOLDER / name


def load_weights(path: Path) -> dict[str, Any]:
    """Load the state dict of each agent's network, or state of each transform; runs no code of the file."""
    return read_tensors(path, "holds no weights")


class StoredWeights(NamedTuple):
    """What a run keeps of its agents."""

    path: Path
    """The file that held the weights."""
    networks: Mapping[str, Any]
    """The state dict of each acting network, by "replica_0/agent_0" and so on."""
    transforms: Mapping[str, Any]
    """What the transforms of the environment had learned."""
    decisions: Mapping[str, Any]
    """The values of what each lane decides."""


def weights_in(run: Path, name: str | None = None) -> StoredWeights:
    """Load what a run keeps of its agents.

    Args:
        name: of a file in its `checkpoints/`, without suffix; None for the final one, or the newest readable
            checkpoint of a run that has not ended.
    """
    refuse_missing(run)
    folder = run / FOLDER
    path = folder / f"{name or 'final'}.pt"
    if name is None and not path.exists():
        return _from_checkpoint(run)
    # Those of as many episodes, of a run that was extended.
    suffix = name.removeprefix("final") if name is not None and name.startswith("final") else ""
    contents = []
    for beside in (folder / TRANSFORMS, folder / DECISIONS):
        earlier = beside.with_stem(f"{beside.stem}{suffix}")
        beside = earlier if earlier.exists() else beside
        contents.append(load_weights(beside) if beside.exists() else {})
    return StoredWeights(path, load_weights(path), *contents)


def lacks_weights(run: Path) -> bool:
    """Whether a run has ended and keeps no weights, since its results were exported without them."""
    if not (run / REPORT).exists() or (run / FOLDER / "final.pt").exists():
        return False
    refuse_missing(run)
    return True


def _from_checkpoint(run: Path) -> StoredWeights:
    final = run / FOLDER / "final.pt"
    if lacks_weights(run):
        raise ValueError(
            f"{run} keeps no weights: its results were exported without them, or {final} was lost; allowed: "
            "the run itself, or an export with weights"
        )
    checkpoints = checkpoints_in(run / FOLDER)
    so_far = 0 if checkpoints else _episodes_in(run)
    if so_far:
        raise ValueError(
            f"{run} has {so_far} episodes, of all replicas together, and no checkpoint yet "
            f"({_writer_of(run)}); read_episodes reads them, and all else works from the first checkpoint on"
        )
    reasons = [f"{final} is not there, nor a readable checkpoint: has {run} been trained?"]
    for checkpoint in reversed(checkpoints):
        try:
            state = read_checkpoint(checkpoint)
            networks = [learner["networks"] for learner in state["learners"]]
        except (ValueError, KeyError) as error:
            reasons.append(str(error))
            continue
        decisions: Mapping[str, Any] = next(iter(state.get("decisions", ())), {})
        return StoredWeights(
            checkpoint,
            {lane: weights for by_lane in networks for lane, weights in by_lane.items()},
            state.get("env", {}).get("transforms", {}),
            decisions.get("_extra_state", {}).get("learned", {}),
        )
    raise ValueError("; ".join(reasons))


def _episodes_in(run: Path) -> int:
    """Return how many episodes the table of a run has, of all replicas together; 0 of a run without one."""
    try:
        agents = read_episodes(run)["agent"].to_numpy()
    except FileNotFoundError:
        return 0
    return int((agents == 0).sum())


def _writer_of(run: Path) -> str:
    if (run / LOCK_FILE).exists():
        return f"{holder_of(run)} is writing it, or was killed"
    return f"nobody is writing it; to resume it: {resume_command(run)}"


FIELD: Final = "frozen"
"""Of `recipe.json`: the checksum of the weights of each run whose agents play, by the path of that run."""


def partners_of(run: Path, partners: Iterable[str]) -> dict[str, dict[str, str]]:
    """Return what the recipe of a run says of which weights of other runs play in it; those that have not
    ended keep changing, and are left out.

    Args:
        run: the directory of the run that begins.
        partners: see `cprl.population.partners_in`.
    """
    final = {os.path.relpath(partner, run): Path(partner) / FOLDER / "final.pt" for partner in partners}
    digests = {partner: checksum(path) for partner, path in final.items() if path.exists()}
    return {FIELD: digests} if digests else {}


def weights_of(recipe: Mapping[str, Any], run: Path, partner: str) -> str | None:
    """The name of the weights of another run that play in a run; None for the final ones it has now."""
    wanted = (recipe.get(FIELD) or {}).get(os.path.relpath(partner, run))
    if wanted is None:
        return None
    folder = Path(partner) / FOLDER
    for path in (folder / "final.pt", *sorted(folder.glob("final-*.pt"))):
        if path.exists() and checksum(path) == wanted:
            return path.stem
    raise ValueError(
        f"{partner} no longer has the weights that play in {run} (a file with the checksum {wanted} "
        f"in its {FOLDER}/); allowed: the run as it was, extended, or its export"
    )


def weights_that_played(run: Path, partners: Sequence[str]) -> dict[str, str]:
    """Return the names of the weights of other runs that played when a run began, by the other run; those
    that it does not name are left out."""
    recipe = read_recipe(run) if partners else {}
    names = {partner: weights_of(recipe, run, partner) for partner in partners}
    return {partner: name for partner, name in names.items() if name is not None}
