"""Saves and loads the weights of networks."""

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

import torch
from torch import Tensor, nn

from cprl.checks import shown
from cprl.runs.checkpoints import FOLDER, REPORT, checkpoints_in, read_checkpoint
from cprl.runs.files import checksum, refuse_missing, refuse_special, verify, write_listed


def save_weights(run: Path, networks: Mapping[str, nn.Module], *, name: str = "final") -> Path:
    """Writes the weights of each agent's network atomically, and lists them in the run's manifest.

    Args:
        networks: the networks by the agent's name.
        name: the name of the file, without suffix.

    Returns:
        `checkpoints/<name>.pt` of the run, which `load_weights` reads.
    """
    if not isinstance(name, str) or not name or Path(name).name != name or "\0" in name:
        raise ValueError(f"name is {shown(name)}; allowed: the name of a file, without slashes and suffix")
    run = Path(run)
    weights = {agent: network.state_dict() for agent, network in networks.items()}
    return write_listed(run, f"checkpoints/{name}.pt", lambda file: torch.save(weights, file))


TRANSFORMS: Final = "transforms.pt"
"""The file in `checkpoints/` with the state of the environment's transforms."""


def save_transforms(run: Path, state: Mapping[str, Any]) -> None:
    """Writes the state of an environment's transforms atomically; writes no file if they have none."""
    if state:
        write_listed(run, f"checkpoints/{TRANSFORMS}", lambda file: torch.save(dict(state), file))


DECISIONS: Final = "decisions.pt"
"""The file in `checkpoints/` with the values of what agents decide, by the agent's name."""


def save_decisions(run: Path, values: Mapping[str, Tensor]) -> None:
    """Writes the values of agents' decisions atomically; writes no file if they learn none.

    Args:
        values: float64 [C] by the agent's name, see `cprl.learners.decisions.BanditDecider.learned`.
    """
    run = Path(run)
    if values:
        write_listed(run, f"checkpoints/{DECISIONS}", lambda file: torch.save(dict(values), file))


def load_weights(path: Path) -> dict[str, Any]:
    """The state dict of each agent's network, or the state of each transform; loads tensors only, and runs no
    code of the file."""
    refuse_special(path)
    if path.exists():
        verify(path)
    try:
        content = torch.load(path, weights_only=True)
    except Exception as error:  # of whatever kind torch finds for what a file may hold
        raise ValueError(f"{path} holds no weights: {error}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path} holds no weights, but a {type(content).__name__}")
    return content


class Kept(NamedTuple):
    """What a run keeps of its agents."""

    path: Path
    """The file that held the weights."""
    networks: Mapping[str, Any]
    """The state dict of each acting network, by "replica_0/agent_0" and so on."""
    transforms: Mapping[str, Any]
    """What the transforms of the environment had learned."""
    decisions: Mapping[str, Any]
    """The values of what each lane decides."""


def kept_of(run: Path, name: str | None = None) -> Kept:
    """What a run keeps of its agents.

    Args:
        name: of a file in its `checkpoints/`, without suffix; None for the final one, or the newest readable
            checkpoint of a run that has not ended.
    """
    refuse_missing(run)
    folder = run / FOLDER
    path = folder / f"{name or 'final'}.pt"
    if name is None and not path.exists():
        return _from_checkpoint(run, path)
    beside = (_beside(folder / own, name) for own in (TRANSFORMS, DECISIONS))
    return Kept(path, load_weights(path), *beside)


def _beside(path: Path, name: str | None) -> dict[str, Any]:
    """What a file beside the weights holds; that of as many episodes, of a run that was extended."""
    if name is not None and name.startswith("final"):
        of_name = path.with_stem(name.replace("final", path.stem))
        path = of_name if of_name.exists() else path
    return load_weights(path) if path.exists() else {}


def lacks_weights(run: Path) -> bool:
    """Whether a run has ended and keeps no weights, since its results were exported without them."""
    if not (run / REPORT).exists() or (run / FOLDER / "final.pt").exists():
        return False
    refuse_missing(run)
    return True


def _from_checkpoint(run: Path, final: Path) -> Kept:
    if lacks_weights(run):
        raise ValueError(
            f"{run} keeps no weights: its results were exported without them, or {final} was lost; allowed: "
            "the run itself, or an export with weights"
        )
    reasons = []
    for checkpoint in reversed(checkpoints_in(run / FOLDER)):
        try:
            state = read_checkpoint(checkpoint)
            of_learners = [learner["networks"] for learner in state["learners"]]
        except (ValueError, KeyError) as error:
            reasons.append(str(error))
            continue
        networks = {lane: own for networks in of_learners for lane, own in networks.items()}
        decisions = state.get("decisions", {}).get("_extra_state", {}).get("learned", {})
        return Kept(checkpoint, networks, state.get("env", {}).get("transforms", {}), decisions)
    raise ValueError(
        "; ".join([f"{final} is not there, nor a readable checkpoint: has {run} been trained?", *reasons])
    )


FIELD: Final = "frozen"
"""Of `recipe.json`: the checksum of the weights of each run whose agents play, by the path of that run."""


def partners_of(run: Path, partners: Iterable[str]) -> dict[str, dict[str, str]]:
    """What the recipe of a run says of which weights of other runs play in it; those that have not ended keep
    changing, and are left out.

    Args:
        run: the directory of the run that begins.
    """
    final = {own: Path(own) / FOLDER / "final.pt" for own in partners}
    found = {os.path.relpath(own, run): checksum(path) for own, path in final.items() if path.exists()}
    return {FIELD: found} if found else {}


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
