"""python -m tests.fuzz: generated inputs for all that is public, and a table of what they came to.

--case N of a --only TARGET runs that one case again, with its traceback.
"""

import argparse
import os
import sys
import time
import traceback
from collections import Counter
from pathlib import Path
from typing import Final

from . import cases, register, runner, runs, table, workers
from .runner import Outcome
from .workers import Task, first_seed

LEAST: Final = {cases.CONSTRUCTOR: 500, cases.FUNCTION: 200, cases.FILE: 200, cases.COMMAND: 200}
"""Cases of a target by its kind; constructors of plain values share what is left of all."""
MOST_SHOWN: Final = 5
"""Findings of a target that are printed, each of another kind."""


def main() -> int:
    """The command line; 1 where something was neither accepted nor refused as documented."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--cases", type=int, default=100_000, help="of all targets together, at least")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="targets whose name has this in it")
    parser.add_argument("--each", type=int, help="so many cases of each target, in place of --cases")
    parser.add_argument("--case", type=int, help="this case alone, in this process")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes at once")
    parser.add_argument("--out", type=Path, help="a Markdown file to be")
    given = parser.parse_args()
    runs.root()
    targets = {name: own for name, own in register.targets().items() if given.only in name}
    if not targets:
        parser.error(f"--only is {given.only!r}; allowed: a part of the name of a target")
    tasks = _tasks(targets, given)
    if given.case is not None:
        return _one(tasks[0], given.case)
    outcomes: dict[str, Outcome] = {}
    began = time.monotonic()

    def ended(task: Task, outcome: Outcome) -> None:
        outcomes[task.name] = outcome
        _show(task, outcome)

    workers.run_all(tasks, jobs=given.jobs, ended=ended)
    words = [f"--cases {given.cases}"] if given.each is None else [f"--each {given.each}"]
    words += [f"--only {given.only}"] if given.only else []
    text = table.markdown(
        outcomes, targets, command=" ".join(["python -m tests.fuzz", *words, f"--seed {given.seed}"])
    )
    if given.out:
        given.out.write_text(text, encoding="utf-8")
    elsewise = sum(own.elsewise for own in outcomes.values())
    number = sum(own.cases for own in outcomes.values())
    print(f"{number:,} cases of {len(outcomes)} targets in {time.monotonic() - began:.0f} s: {elsewise} else")
    return 1 if elsewise else 0


def _tasks(targets: dict[str, cases.Target], given: argparse.Namespace) -> list[Task]:
    """The slow ones first, so that no process waits for the last one."""
    numbers = {name: given.each or LEAST[own.kind] for name, own in targets.items()}
    shared = [name for name, own in targets.items() if own.weight > 1]
    left = given.cases - sum(numbers.values())
    if given.each is None and not given.only and left > 0:
        for name in shared:
            numbers[name] += -(-left // len(shared))
    order = sorted(targets, key=lambda name: (targets[name].weight, name))
    return [Task(name, numbers[name], given.seed) for name in order]


def _show(task: Task, outcome: Outcome) -> None:
    counts = outcome.counts
    print(
        f"{task.name:58s} {counts[runner.ACCEPTED]:6d} accepted {counts[runner.REFUSED]:6d} refused "
        f"{outcome.elsewise:6d} else",
        flush=True,
    )
    kinds = Counter(own.what[:60] for own in outcome.findings)
    for kind, number in kinds.most_common(MOST_SHOWN):
        own = next(own for own in outcome.findings if own.what[:60] == kind)
        print(f"    {number} x {own.what[:300]}\n      {own.shown[:300]}")
        print("".join(f"      {line.strip()[:200]}\n" for line in own.trace.splitlines()[-2:]), end="")
        print(
            f"      again: python -m tests.fuzz --only {task.name!r} --each {task.cases} --seed {task.seed} "
            f"--case {own.case}",
            flush=True,
        )


def _one(task: Task, number: int) -> int:
    target, how = register.targets()[task.name], []
    workers.prepare()

    def each(at: int, case: cases.Case) -> None:
        if at == number:
            print(f"{task.name}({case.shown()})", flush=True)
            with runner.kept_errors() as kept:
                how.append(runner.run_case(target, case, at))
            for error in kept:
                traceback.print_exception(error)

    runner.cases_of(target, task.cases, first_seed=first_seed(task), each=each)
    print(how[0] if how else f"there is no case {number}")
    return 0 if how and isinstance(how[0], str) else 1


if __name__ == "__main__":
    sys.exit(main())
