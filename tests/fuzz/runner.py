"""Runs the cases of a target, and says how each ended: accepted, refused as documented, or anything else."""

import contextlib
import gc
import io
import os
import resource
import signal
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import psutil
import torch
from hypothesis import HealthCheck, Phase, given, seed, settings

from .cases import Case, Target
from .runs import Stopped

LONGEST_S: Final = 10.0
"""What a case may take."""
WAITS_S: Final = 0.002
"""Seconds of the processor, within two seconds: a case that takes less does not work but wait."""
LARGEST_GROWTH_KIB: Final = 2 * 2**20
"""By which a case may raise the largest resident memory of the process."""
MUCH_MEMORY: Final = 2**30
"""Bytes from which on what a case left behind is collected at once."""
LONGEST_MESSAGE: Final = 2_000
"""In characters; a refusal says something, and not more than anybody reads."""

ACCEPTED: Final = "accepted"
REFUSED: Final = "refused"


class TooSlowError(BaseException):
    """Ends a case that takes too long; no library may catch it as an error of its own."""


@dataclass
class Finding:
    """A case that ended otherwise."""

    case: int
    what: str
    shown: str
    trace: str = field(default="", repr=False)


@dataclass
class Outcome:
    """How the cases of a target ended."""

    counts: Counter[str] = field(default_factory=Counter)
    findings: list[Finding] = field(default_factory=list)
    elsewise: int = 0

    def add(self, case: int, how: str | Finding) -> None:
        """Counts a case."""
        if isinstance(how, str):
            self.counts[how] += 1
        else:
            self.elsewise += 1
            self.findings.append(how)

    @property
    def cases(self) -> int:
        """How many cases there were."""
        return sum(self.counts.values()) + self.elsewise


def cases_of(target: Target, number: int, *, first_seed: int, each: Callable[[int, Case], None]) -> None:
    """Calls `each` with exactly so many cases of a target, the same for the same seed.

    hypothesis stops early where it has seen all that a strategy can draw; the next seed goes on then.
    """
    at = 0
    for own_seed in range(first_seed, first_seed + 10 * number + 10):

        @seed(own_seed)
        @settings(
            max_examples=number - at,
            database=None,
            deadline=None,
            phases=[Phase.generate],
            suppress_health_check=list(HealthCheck),
            derandomize=False,
        )
        @given(target.cases)
        def one(case: Case) -> None:
            nonlocal at
            if at < number:
                each(at, case)
                at += 1

        one()
        if at >= number:
            return
    raise RuntimeError(f"{target.name}: hypothesis drew {at} cases of {number}")


def run_case(target: Target, case: Case, number: int) -> str | Finding:
    """How a case ends."""
    shown = case.shown()
    with _folder() if target.in_folder else contextlib.nullcontext():
        try:
            return _ended(target, case, number, shown)
        finally:
            torch.set_flush_denormal(False)  # trainings set it, and hypothesis refuses to draw with it
            if target.in_folder and psutil.Process().memory_info().rss > MUCH_MEMORY:
                gc.collect()  # replay buffers, of which errors and frames know each other


def _ended(target: Target, case: Case, number: int, shown: str) -> str | Finding:
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        with _deadline(), warnings.catch_warnings(), _quiet() as said:
            warnings.simplefilter("ignore")
            warnings.simplefilter("error", RuntimeWarning)
            result = target.call(case)
            wrong = target.after(case, result) if target.after else None
    except Stopped:
        return ACCEPTED
    except TooSlowError:
        return Finding(number, f"took longer than {LONGEST_S:g} s", shown, traceback.format_exc())
    except BaseException as error:
        if _KEPT:
            _KEPT[-1].append(error)
        how = _refusal(target, case, error)
        return how if how in (ACCEPTED, REFUSED) else Finding(number, how, shown, _last_lines(error))
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    if grown > LARGEST_GROWTH_KIB:
        return Finding(number, f"took {grown / 2**20:.1f} GiB of memory", shown)
    if wrong:
        return Finding(number, f"accepted, but {wrong}", shown, said.getvalue()[-500:])
    return ACCEPTED


_KEPT: list[list[BaseException]] = []
"""Where errors are kept, if anywhere: they hold whatever their frames do."""


@contextlib.contextmanager
def kept_errors() -> Iterator[list[BaseException]]:
    """What cases raise, for people who look at it."""
    _KEPT.append([])
    try:
        yield _KEPT[-1]
    finally:
        _KEPT.pop()


def _refusal(target: Target, case: Case, error: BaseException) -> str:
    """`REFUSED` where this is one of the documented ways, else what is wrong with it."""
    kind, message = type(error).__name__, str(error)
    if isinstance(error, SystemExit):
        if not (target.is_command or SystemExit in target.refusals):
            return "SystemExit"
        if error.code in (0, None):
            return ACCEPTED  # --help and --version
        return REFUSED if error.code == 2 or _is_sentence(str(error.code)) else f"exits with {error.code!r}"
    if not isinstance(error, target.refusals) and not (case.misfits and isinstance(error, TypeError)):
        return f"{kind}: {message[:200]}"
    if not message.strip():
        return f"{kind} without a message"
    if len(message) > LONGEST_MESSAGE:
        return f"{kind} with a message of {len(message)} characters: {message[:100]}"
    return REFUSED


def _is_sentence(text: str) -> bool:
    return 0 < len(text.strip()) <= LONGEST_MESSAGE and " " in text


def _last_lines(error: BaseException) -> str:
    try:
        frames = traceback.extract_tb(error.__traceback__)
        own = [frame for frame in frames if "/cprl/" in frame.filename][-3:]
        lines = [f"{frame.filename.rpartition('/src/')[2]}:{frame.lineno} {frame.line}" for frame in own]
        return "\n".join(lines)
    except RecursionError:
        return ""


@contextlib.contextmanager
def _deadline() -> Iterator[None]:
    """Raises `TooSlowError` in this thread once a case has taken too long.

    On a busy machine that is time of the processor; where none of it passes, the case waits for something.
    """
    began = last = time.process_time()

    def late(number: int, frame: Any) -> None:
        nonlocal last
        now = time.process_time()
        waits, last = now - last < WAITS_S, now
        if waits or now - began > LONGEST_S:
            raise TooSlowError

    usual = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, LONGEST_S, LONGEST_S / 5)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, usual)


@contextlib.contextmanager
def _folder() -> Iterator[None]:
    """An empty working directory, some folders deep."""
    usual = Path.cwd()
    with tempfile.TemporaryDirectory(prefix="cprl-case-", ignore_cleanup_errors=True) as place:
        own = Path(place) / "a" / "b" / "c"
        own.mkdir(parents=True)
        os.chdir(own)
        try:
            yield
        finally:
            os.chdir(usual)


@contextlib.contextmanager
def _quiet() -> Iterator[io.StringIO]:
    """Keeps what is printed."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        yield said
