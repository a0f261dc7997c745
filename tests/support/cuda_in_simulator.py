"""Compares the CUDA driver in Numba's simulator with the CPU driver; `test_cuda.py` runs it in a subprocess.

NUMBA_ENABLE_CUDASIM=1 python tests/support/cuda_in_simulator.py
"""

import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from boards import only_quirks, random_actions
from governed import EVERYTHING, random_decisions
from numba import cuda
from numba.core import config

from cprl import Game, Observation, RandomEnd, River, Rules, institutions as law, maps, presets
from cprl.commons.batch import Batch
from cprl.commons.cuda import THREADS_PER_BLOCK, CudaThreads

GAMES = presets.GAMES
WALLS = maps.parse(
    """
    A>A#.<.
    .A.#A.A
    ..#..v.
    """
)


def both(game: Game, worlds: int) -> tuple[Batch, Batch]:
    """The same worlds on both drivers."""
    return Batch(game, worlds, seed=3), Batch(game, worlds, seed=3, driver=CudaThreads(game, worlds))


def arrays_of(record: Any) -> dict[str, Any]:
    """The entries of a record, those of a group of rules in place of the group."""
    entries = {}
    for name, entry in record._asdict().items():
        entries |= arrays_of(entry) if hasattr(entry, "_asdict") else {name: entry}
    return entries


def assert_same(cpu: Batch, gpu: Batch, output, gpu_output, when: object) -> None:
    """Worlds and step outputs are equal; with institutions also all their arrays."""
    records = [(output, gpu_output), (cpu.now, gpu.now)]
    if cpu.law is not None:
        records += zip(cpu.law, gpu.law, strict=True)
    for ours, theirs in records:
        others = arrays_of(theirs)
        for name, array in arrays_of(ours).items():
            if isinstance(array, np.ndarray):
                other = gpu.driver.read(others[name])
                if array.dtype != other.dtype or not np.array_equal(array, other):
                    raise AssertionError(f"{name} differs, {when}: {array} {other}")


def play(game: Game, *, worlds: int = 2, turns: int = 12) -> Batch:
    """Both drivers play the same turns; halfway through, some worlds begin a new episode. Returns those of
    the CPU."""
    cpu, gpu = both(game, worlds)
    output, gpu_output = cpu.begin(), gpu.begin()
    assert_same(cpu, gpu, output, gpu_output, "at the start")
    decisions = random_decisions(turns, worlds, game)
    actions = random_actions(turns, worlds, game)
    for number, (turn, decided) in enumerate(zip(actions, decisions, strict=True)):
        cpu.play(turn, output, decided)
        gpu.play(cuda.to_device(turn), gpu_output, cuda.to_device(decided))
        assert_same(cpu, gpu, output, gpu_output, f"turn {number}")
        if number == turns // 2:
            which = np.arange(worlds) % 2 == 1
            cpu.begin(output, which)
            gpu.begin(gpu_output, cuda.to_device(which))
            assert_same(cpu, gpu, output, gpu_output, "after a new episode began")
    assert np.array_equal(cpu.boards(), gpu.driver.read(gpu.boards()))
    return cpu


def forms() -> None:
    """Every form of observation."""
    rules = Rules(regrow_prob=(0.1, 0.5), freeze_steps=4, episode_steps=20, window_rows=3, window_columns=5)
    for encoding in ("rgb", "one_hot"):
        for area in ("window", "full"):
            for others in (False, True):
                form = Observation(
                    area=area, encoding=encoding, agents_apart=others, scoreboard=others, stock_gauge=others
                )
                play(Game(map=WALLS, rules=rules, observation=form))


def blocks() -> None:
    """More worlds than a block has threads."""
    play(Game(map=WALLS, rules=Rules(freeze_steps=2)), worlds=THREADS_PER_BLOCK + 3, turns=3)


def state() -> None:
    """A state is loaded from one driver into the other, and `set_seed` restarts both."""
    game = presets.game("two_complex")
    cpu, gpu = both(game, 3)
    output, gpu_output = cpu.begin(), gpu.begin()
    for turn in random_actions(30, 3, game):
        cpu.play(turn, output)
    gpu.load(cpu.state(), gpu_output)
    turn = random_actions(1, 3, game, seed=9)[0]
    cpu.play(turn, output)
    gpu.play(cuda.to_device(turn), gpu_output)
    assert_same(cpu, gpu, output, gpu_output, "after loading")
    assert all(np.array_equal(array, gpu.state()[name]) for name, array in cpu.state().items())
    shown, gpu_shown = cpu.show(output, world=1), gpu.show(gpu_output, world=1)
    assert all(map(np.array_equal, shown, gpu_shown))
    for batch, written in ((cpu, output), (gpu, gpu_output)):
        batch.set_seed(11)
        batch.begin(written)
    assert_same(cpu, gpu, output, gpu_output, "after set_seed")


def unknown() -> None:
    """Unknown actions are refused."""
    game = presets.game("commons")
    _, gpu = both(game, 3)
    gpu.begin()
    actions = np.zeros((3, 4), np.int64)
    actions[1, 2], actions[2, 0] = 8, -1
    with pytest.raises(ValueError, match="action 8 of agent 2 in world 1 is unknown; allowed: 0 to 7"):
        gpu.check(cuda.to_device(actions))


def institutions() -> None:
    """Every kind of institution at once; what was played is loaded and goes on."""
    state = play(EVERYTHING, turns=8).state()
    cpu, gpu = both(EVERYTHING, 2)
    output, gpu_output = cpu.load(state), gpu.new_output()
    gpu.load(state, gpu_output)
    assert_same(cpu, gpu, output, gpu_output, "after loading")
    (turn,) = random_actions(1, 2, EVERYTHING, seed=9)
    cpu.play(turn, output)
    gpu.play(cuda.to_device(turn), gpu_output)
    assert_same(cpu, gpu, output, gpu_output, "without decisions")
    wrong = np.zeros((2, 3), np.int64)
    wrong[1, 1] = EVERYTHING.decisions
    with pytest.raises(ValueError, match=f"decision {EVERYTHING.decisions} of agent 1 in world 1 is unknown"):
        gpu.check_decisions(cuda.to_device(wrong))


def stopped() -> None:
    """Institutions that stop bites and shots, on a board as run; the tables of others are empty."""
    own = (
        law.Boundaries.drawn("001122-\n.......\n..3..22", owners=("01", "13", "2")),
        *(law.Quota(share=0.5), law.ClosedSeason(period_steps=4, closed_steps=1), law.ClosedPatches()),
        *(law.Rotation(window_steps=4), law.Sanctioner(agents=(1, 2))),
        law.GraduatedSanctions(freeze_steps=((1,), (2,), (3,)), on="tags"),
    )
    quirks = only_quirks(freeze_counts_tag_turn=True)
    rules = replace(EVERYTHING.rules, clashes="pairwise", growth="before_bites", quirks=quirks)
    play(replace(EVERYTHING, rules=rules, institutions=own), turns=6)


def literature() -> None:
    """Every rule that the study does not have: two small games have them all between them."""
    plain = {"regrow_prob": (0.1, 0.5), "freeze_steps": 2, "window_rows": 3, "window_columns": 5}
    beams = dict.fromkeys(("beam_tapers", "beam_from_beside", "beam_stops_at_agents"), True)
    both_begin = {"random_headings": True, "respawn_at_spawns": True, "first_stock_share": 0.5}
    by_chance = RandomEnd(prob=0.1)
    first = Rules(**plain, **beams, **both_begin, clashes="in_turn", cooldown_steps=2, random_end=by_chance)
    second = Rules(
        **(plain | {"window_rows_behind": 1, "regrow_under_agents": False, "growth": "after_bites"}),
        **(both_begin | {"clashes": "one_moves", "harvest_action": True, "regrow_by": "share"}),
        river=River(may_clean=True, pollution_prob=0.5, pollution_limit=0.9),
        plays_on_when_empty=True,
    )
    play(Game(map=maps.parse("A>AP.<.\n.AP#A.A\nPP#P.v.", agents=5), rules=first), turns=16)
    fines = (law.Punishment(fine=2.0, cost=1.0, shot_cost=0.5),)
    river = maps.parse("A>AP~<.\n.AP~H.A\nPPHP.v.", agents=5)
    play(Game(map=river, rules=second, institutions=fines), turns=16)


CHECKS: dict[str, Callable[[], object]] = {
    **{f"{board}:{variant}": partial(play, presets.game(board, variant=variant)) for board, variant in GAMES},
    **{check.__name__: check for check in (forms, blocks, state, unknown, institutions, stopped, literature)},
}

if __name__ == "__main__":
    assert config.ENABLE_CUDASIM, "start with NUMBA_ENABLE_CUDASIM=1"
    for name in sys.argv[1:] or CHECKS:
        CHECKS[name]()
        print(name, "equal", flush=True)
