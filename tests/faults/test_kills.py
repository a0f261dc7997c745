"""SIGKILL at any moment: what is resumed afterwards ends like what was never killed."""

import random
import shutil

import pytest

from .driver import alive, differences, lived
from .experiments import AGENTS, ENGINES
from .kills import COURSE, victim

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("name", AGENTS)
def test_a_run_that_is_killed_in_each_stage_ends_bit_identical(name, engine, tmp_path):
    kills = victim(tmp_path / "runs", name, engine).kills("run", COURSE, random.Random(f"{name} {engine}"))
    assert [kill.outcome for kill in kills] == [""] * len(kills), "\n".join(kill.row for kill in kills)
    # On a busy machine a process may have ended before its kill.
    assert len(kills) >= len(COURSE) - 1, "\n".join(kill.row for kill in kills)


@pytest.mark.parametrize("stage", ["weights", "evaluation", "figures"])
def test_a_kill_before_any_file_operation_after_the_training_loses_nothing(stage, shop, trained, twin):
    whole, ended = twin
    lost = {}
    for nth in range(1, ended.operations[stage] + 1):
        run = shop.folder / f"run-{nth}"
        shutil.copytree(trained, run)
        with alive(shop.resumed(run.name, pause=(stage, nth))) as process:
            paused = process.paused()
        resumed = lived(shop.resumed(run.name))
        found = differences(run, whole) if resumed.code == 0 else resumed.err
        if found:
            lost[f"{nth}: {paused}"] = found
    assert not lost


def test_the_gate_closes(twin, tmp_path):
    """A row twice, a weight changed by one bit and a file left behind are seen."""
    import pyarrow as pa
    import pyarrow.parquet as pq
    import torch

    whole, _ = twin
    run = tmp_path / "run"
    shutil.copytree(whole, run)
    assert differences(run, whole) == []
    table = pq.read_table(run / "episodes.parquet")
    pq.write_table(pa.concat_tables([table, table.slice(3, 1)]), run / "episodes.parquet")
    weights = torch.load(run / "checkpoints" / "final.pt", weights_only=True)
    next(iter(next(iter(weights.values())).values())).view(torch.int32).view(-1)[0] ^= 1
    torch.save(weights, run / "checkpoints" / "final.pt")
    (run / "checkpoints" / "training.0123abcd.partial").touch()
    (run / "report.json").unlink()
    assert differences(run, whole) == [
        "report.json is missing",
        "checkpoints/training.0123abcd.partial is left",
        "checkpoints/final.pt differs",
        "episodes.parquet differs",
    ]
