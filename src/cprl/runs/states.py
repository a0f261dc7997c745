"""The state of a run's directory: what was done, what follows, and how a run is extended."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final, Literal

from cprl.runs.checkpoints import CHECKPOINTS, checkpoints_in, endings_of, read_checkpoint, steps_of
from cprl.runs.files import RECIPE_FILE, REPORT, refuse_missing, rename_listed
from cprl.runs.length import Length
from cprl.runs.recipe import start_run, write_length
from cprl.runs.weights import frozen_checksums

RunState = Literal["missing", "begun", "stopped", "finished"]
Step = Literal["start", "resume", "extend", "already_finished"]

SESSION: Final = "session"
"""The field of `recipe.json` with the session that a hosted run is a round of."""
KEEPS_NO_STATE: Final = (
    "it keeps no state of its training to extend it from; a run with --keep-checkpoint does"
)


def state_of(run: Path | None) -> RunState:
    """Return the state of a run's directory.

    Returns:
        "missing" without a recipe or directory; "begun" with a recipe, but no checkpoint yet; "stopped" with
        a checkpoint to resume from; "finished" with a report.
    """
    if run is None:
        return "missing"
    if (run / REPORT).exists():
        return "finished"
    if not (run / RECIPE_FILE).exists():
        return "missing"
    return "stopped" if checkpoints_in(run / CHECKPOINTS) else "begun"


def next_step(state: RunState, length: Length, requested: Length) -> Step:
    """Return the next step that turns a directory into a finished run of the length `requested`.

    Args:
        length: the length of the run so far.
        requested: the length that it shall have.
    """
    if state == "missing":
        return "start"
    if length.is_shorter_than(requested):
        return "extend"
    return "already_finished" if state == "finished" else "resume"


def start(out: Path | None, experiment: Any, partners: Iterable[str], *, session: str | None = None) -> Path:
    """Create the directory of a run of an `Experiment`, with its recipe; see `start_run`.

    Args:
        partners: the runs whose agents play too, see `cprl.population.partners_in`.
        session: of a hosted game, what its rounds have in common and no other session has: the same groups of
            people play them.
    """
    more = {} if session is None else {SESSION: session}

    def to_recipe(run: Path) -> dict[str, Any]:
        return {**experiment.to_recipe(run), **frozen_checksums(run, partners), **more}

    return start_run(out, experiment.name, to_recipe)


def refuse_to_extend(run: Path, length: Length, callbacks: Iterable[Any]) -> None:
    """Refuse to extend a run if it could differ from a run that had begun with the greater length.

    Args:
        length: the length of the run so far.
        callbacks: those of the training; one with `on_start` sees the number of episodes, and may depend on
            it, unless its `is_extendable` is true.
    """
    refuse_missing(run)
    for callback in callbacks:
        if depends_on_episodes(callback):
            raise ValueError(
                f"{run} has the callback {type(callback).__name__}, whose on_start sees the number of "
                "episodes, so that a longer training may differ from the first episode on; if it does not: "
                "is_extendable = True in its class"
            )
    endings = endings_of(run)
    if endings:
        read_checkpoint(endings[-1])
        return
    if state_of(run) == "finished" or (run / CHECKPOINTS / "final.pt").exists():
        raise ValueError(f"{run} is finished; {KEEPS_NO_STATE}")
    checkpoints = checkpoints_in(run / CHECKPOINTS)
    if length.is_of_steps or not checkpoints:
        return
    if max(read_checkpoint(checkpoints[-1])["played"]) >= length.number:
        raise ValueError(
            f"{run} was stopped while its last replicas played their last episodes, and keeps no state from "
            "before; finish it with as many episodes as it has"
        )


def depends_on_episodes(callback: Any) -> bool:
    """Return whether a callback, or a class of callbacks, may depend on the number of episodes of a
    training."""
    return hasattr(callback, "on_start") and not getattr(callback, "is_extendable", False)


def extend(run: Path, before: Length, length: Length) -> None:
    """Make a run longer, so that it can be resumed.

    Results so far are kept under names with their episodes or steps: `checkpoints/final-4800.pt`,
    `evaluation-4800/`, `report-4800.json`. It can be repeated if it was interrupted: the recipe changes last.

    Args:
        run: its directory, which `refuse_to_extend` has checked.
        before: its length so far.
        length: its new length.
    """
    weights = [f"{CHECKPOINTS}/{name}.pt" for name in ("final", "transforms", "decisions")]
    for name in (REPORT, *weights, "evaluation"):
        path = run / name
        if path.exists():
            renamed = path.with_stem(f"{path.stem}-{before.number}")
            rename_listed(run, name, renamed.relative_to(run).as_posix())
    last = max(map(steps_of, endings_of(run)), default=None)
    for path in checkpoints_in(run / CHECKPOINTS):
        if last is not None and steps_of(path) > last:
            path.unlink()
    write_length(run, before, length)
