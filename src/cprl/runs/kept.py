"""What a run keeps of its agents: of one that has not ended, what its newest checkpoint holds."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from cprl.runs.checkpoints import FOLDER, checkpoints_in, read_checkpoint
from cprl.runs.extension import REPORT
from cprl.runs.manifest import refuse_missing
from cprl.runs.weights import DECISIONS, TRANSFORMS, load_weights


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
        run: its directory.
        name: of a file in its `checkpoints/`, without suffix; None for the final one, or the newest readable
            checkpoint of a run that has not ended.

    Raises:
        ValueError: if a file that the manifest lists is not there, or nothing is readable; names each file
            with its reason.
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
    """Whether a run has ended and keeps no weights, since its results were exported without them.

    Raises:
        ValueError: if the run had them: its manifest lists a file that is not there.
    """
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
