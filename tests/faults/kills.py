"""SIGKILL at random moments of a run, which is resumed after each and compared with an undisturbed one."""

import random
import re
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Final

from .child import STAGES, Life
from .driver import Ended, Workshop, alive, differences, lived, progress
from .experiments import AGENTS, ENGINES, experiment

COURSE: Final = ("start", "training", "training", "weights", "evaluation", "figures")
"""The stages in which a run is killed, in this order."""

_SHARE: Final = 0.4
"""The part of a training in which it is killed, so that there is something left for the next kill."""


@dataclass(frozen=True, kw_only=True)
class Kill:
    """One kill, and what became of the run."""

    experiment: str
    engine: str
    stage: str
    moment: str
    step: int
    """Of the newest checkpoint."""
    rows: int
    """Of the table of episodes."""
    outcome: str = ""
    """What is wrong with the run in the end, "" if it is the same as the undisturbed one."""

    @property
    def row(self) -> str:
        """Its cells in the table of the docs."""
        where = f"{self.experiment}, {self.engine} | {self.stage} | {self.moment}"
        return f"{where} | {self.step} | {self.rows} | {self.outcome or 'bit-identical'} |"


HEAD: Final = (
    "| kill | run | stage | moment | newest checkpoint, step | rows in the table | resumed to the end |\n"
    "|---:|---|---|---|---:|---:|---|"
)


@dataclass(frozen=True)
class Victim:
    """Runs of one experiment that are killed, and the one that is not.

    Args:
        shop: where they are.
        twin: the end of the undisturbed run, `twin` in that folder.
    """

    shop: Workshop
    twin: Ended

    def kills(self, name: str, stages: Sequence[str], chance: random.Random) -> list[Kill]:
        """Kills a run once in each of these stages, and resumes it to its end.

        A process that ends by itself before its moment is the last one.
        """
        done: list[Kill] = []
        run, ended = self.shop.folder / name, None
        for stage in stages:
            life = self.shop.resumed(name) if (run / "recipe.json").exists() else self.shop.started(name)
            moment = self._moment(stage, chance)
            stage_then, told, ended = self._killed(life, moment)
            if ended is not None:
                break
            step, rows = progress(run)
            who = self.shop.experiment
            done.append(
                Kill(
                    experiment=who.name,
                    engine=who.engine,
                    stage=stage_then,
                    moment=told,
                    step=step,
                    rows=rows,
                )
            )
        outcome = self._outcome(run, ended or lived(self.shop.resumed(name)))
        return [replace(kill, outcome=outcome) for kill in done]

    def _moment(self, stage: str, chance: random.Random) -> tuple[str, float | int]:
        """A stage, and seconds after its beginning or the number of a file operation in it."""
        share = _SHARE if stage == "training" else 1.0
        if chance.random() < 0.5:
            ends = min(at for at in self.twin.stages.values() if at > self.twin.stages[stage])
            return stage, share * chance.uniform(0, ends - self.twin.stages[stage])
        return stage, chance.randint(1, max(1, int(share * self.twin.operations[stage])))

    def _killed(self, life: Life, moment: tuple[str, float | int]) -> tuple[str, str, Ended | None]:
        """Kills it at a moment; the stage that it was in, the moment in words, and how it ended if it was
        not there to be killed."""
        stage, at = moment
        with alive(replace(life, pause=(stage, at)) if isinstance(at, int) else life) as process:
            if isinstance(at, int):
                paused = process.paused()
                told = f"before {_shortened(paused[1])}" if paused else ""
            else:
                process.at(stage)
                time.sleep(at)
                told = f"after {at:.3f} s"
            if process.kill():
                return process.stage, told, None
            return process.stage, told, process.end()

    def _outcome(self, run: Path, ended: Ended) -> str:
        if ended.code != 0:
            return f"exit code {ended.code}: {(ended.err.strip().splitlines() or ['nothing said'])[-1]}"
        return "; ".join(differences(run, self.shop.folder / "twin"))


def victim(folder: Path, name: str, engine: str) -> Victim:
    """A new experiment in a folder, with its undisturbed run."""
    folder.mkdir()
    shop = Workshop(folder, experiment(name, engine))
    if engine == "compiled":
        lived(shop.started("first"))  # fills torch's cache of compiled code, which shortens "start"
    twin = lived(shop.started("twin"))
    if twin.code != 0:
        raise RuntimeError(f"the undisturbed run of {name}, {engine}, ended with {twin.code}: {twin.err}")
    return Victim(shop, twin)


def all_kills(folder: Path, kills: int, *, seed: int) -> Iterator[Kill]:
    """So many kills over all experiments and engines, taking turns."""
    chance = random.Random(seed)
    victims = [victim(folder / f"{name}-{engine}", name, engine) for name in AGENTS for engine in ENGINES]
    left = kills
    for nth in count():
        for one in victims:
            done = one.kills(f"run-{nth}", COURSE[:left], chance)
            yield from done
            left -= len(done)
            if left <= 0:
                return


def _shortened(operation: str) -> str:
    """Without the checksums in names of checkpoints."""
    return re.sub(r"-[0-9a-f]{32}", "", operation)


assert set(COURSE) == set(STAGES)
