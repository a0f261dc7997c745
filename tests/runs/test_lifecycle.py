"""A run from its lock to its report: interrupted in any stage and resumed, it ends bit for bit the same."""

import json
import os
import shutil
import signal
import socket
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from dqn_parts import make_learner
from own_experiment import MEADOW, REPLAY
from same_runs import assert_same_training

import cprl
from cprl import Custom, maps
from cprl.algorithms import DQN, PPO, RolloutSettings
from cprl.commands import main as cli
from cprl.commons.spaces import Spaces
from cprl.policies.rng import DRAWN_AHEAD, LaneRng, Purpose, lane_seeds
from cprl.population import Frozen, Learning, Scripted
from cprl.runs.checkpoints import Checkpointer, checkpoints_in, is_ending, read_checkpoint
from cprl.runs.episodes import EpisodeTable, read_episodes, read_table
from cprl.runs.export import export_results
from cprl.runs.files import RunLock, RunLockedError, checksum, refuse_to_write_over, write_atomically
from cprl.runs.recipe import start_run
from cprl.runs.weights import load_weights, save_weights
from cprl.system.shipped import cprl_command
from cprl.training import running

LEARNING = Learning(DQN(settings=replace(REPLAY, hidden_cells=(8,))))
FIELD = replace(
    MEADOW,
    game=replace(
        MEADOW.game,
        map=maps.parse(".A>A.\n..<A."),
        rules=replace(MEADOW.game.rules, regrow_prob=(0.0,), episode_steps=40),
    ),
    agents=[LEARNING, Scripted("random")],
    transforms=(),
    callbacks=(),
    metrics=(),
    episodes=5,
)
"""Its episodes have between ten and forty steps, so that one replica plays on while the other ends."""
STOPPING = replace(FIELD, callbacks=[Custom("own_parts:Stopping")], loggers=())


class InterruptionError(Exception):
    """Stands for whatever ends a process."""


def interrupted(*_, **__):
    raise InterruptionError


def run(experiment, out, **options):
    return cprl.run(experiment, out, **{"watch": "off", "keep_checkpoint": True, **options})


def resumed(experiment, out, **options):
    return run(experiment, out, resume=True, **options)


def assert_same(run, other):
    """Episodes, weights and evaluation are the same bit for bit."""
    assert_same_training(run, other)
    for name in ("random", "trained"):
        path = f"evaluation/{name}.parquet"
        assert read_table(run / path).equals(read_table(other / path))


def final(run, name="final"):
    return load_weights(Path(run) / "checkpoints" / f"{name}.pt")


def copied(run, folder):
    """A copy of a run that has not ended."""
    copy = shutil.copytree(run, folder)
    (copy / "report.json").unlink()
    return copy


def contents(run):
    return {path.relative_to(run).as_posix(): path.read_bytes() for path in run.rglob("*") if path.is_file()}


class Signals:
    """Sends a signal to this process after a step."""

    def __init__(self, number, step):
        self.number, self.left = number, step

    def on_step(self, batch):
        self.left -= 1
        if self.left == 0:
            os.kill(os.getpid(), self.number)


@pytest.mark.integration
@pytest.mark.parametrize(
    ("number", "kind"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, SystemExit)], ids=str
)
def test_a_run_that_a_signal_stops_is_saved_and_raises_what_the_signal_means(
    number, kind, whole, tmp_path, capsys
):
    with pytest.raises(kind) as ended:
        run(FIELD, tmp_path / "run", callbacks=[Signals(number, 30)])
    assert getattr(ended.value, "code", None) in (None, 128 + signal.SIGTERM)
    assert len(checkpoints_in(tmp_path / "run" / "checkpoints")) == 1
    assert "Stopped; everything up to step" in capsys.readouterr().out
    assert_same(resumed(FIELD, tmp_path / "run"), whole)


@pytest.mark.integration
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_command_that_a_signal_stops_says_once_what_resumes_and_exits_as_shells_count(
    number, tmp_path, monkeypatch, capsys
):
    begun, signalled = start_run(tmp_path / "begun", "field", FIELD.to_recipe), cprl.run

    def with_signals(*arguments, **options):
        return signalled(*arguments, **{**options, "callbacks": [Signals(number, 30)]})

    monkeypatch.setattr("cprl.training.running.run", with_signals)
    monkeypatch.setattr("sys.argv", f"cprl run {begun} --out {tmp_path / 'run'} --watch off".split())
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 128 + number
    assert capsys.readouterr().out.count("To resume: ") == 1


def test_sigterm_ends_a_command_as_ctrl_c_does_so_that_files_are_cleared_away(tmp_path, monkeypatch):
    cleared = tmp_path / "cleared"
    begun = start_run(tmp_path / "begun", "field", FIELD.to_recipe)

    def half(*_, **__):
        try:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(5)
        finally:
            cleared.touch()

    before = signal.signal(signal.SIGTERM, signal.SIG_IGN)  # not the end of the tests
    try:
        monkeypatch.setattr("cprl.runs.export.export_results", half)
        monkeypatch.setattr("sys.argv", ["cprl", "export", str(begun), "b"])
        with pytest.raises(SystemExit) as ended:
            cli.main()
    finally:
        signal.signal(signal.SIGTERM, before)
    assert ended.value.code == 143
    assert cleared.exists()


def test_a_network_whose_module_is_not_there_is_missed_by_name_and_not_its_weights(tmp_path):
    experiment = replace(FIELD, agents=[Learning(DQN(settings=REPLAY, network=Custom("gone:Net")))] * 2)
    stored = start_run(tmp_path / "run", "field", experiment.to_recipe)
    save_weights(stored, {"replica_0/agent_0": torch.nn.Linear(2, 8)})
    cprl.trust("gone:Net")
    with pytest.raises(ValueError, match=r"gone:Net.*No module named 'gone'.*PYTHONPATH") as missed:
        cprl.load(stored)
    assert "weights" not in str(missed.value)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = run(FIELD, tmp_path_factory.mktemp("whole") / "run", figures=True)
    table = read_episodes(path).to_pydict()
    steps = [0, 0]
    for replica, played in zip(table["replica"], table["steps"], strict=True):
        steps[replica] += played
    assert steps[0] != steps[1], "one replica plays on while the other ends"
    return path


@pytest.mark.integration
def test_a_finished_run_has_results_their_checksums_and_the_state_to_extend_it_from(whole):
    ending = next(path for path in contents(whole) if path.startswith("checkpoints/ending-"))
    results = ["checkpoints/final.pt", "episodes.parquet"]
    tables = ["evaluation/random.parquet", "evaluation/trained.parquet"]
    listed = json.loads((whole / "manifest.json").read_text())["files"]
    assert sorted(listed) == sorted(results + tables)
    logs = [path for path in contents(whole) if path.startswith("logs/")]
    others = ["figures/training_curve.png", "manifest.json", "recipe.json", "report.json"]
    assert sorted(contents(whole)) == sorted([ending, *results, *tables, *others, *logs])
    report = json.loads((whole / "report.json").read_text())
    assert report["episodes"] == FIELD.episodes
    assert report["acting_storing_updating_s"] > 0
    assert report["acting_storing_updating_s"] + report["compiling_s"] < report["wall_s"]


SLOW = ("save_beside_weights", "training_curve", "write_json", "summarise")


@pytest.mark.integration
@pytest.mark.parametrize(
    "stage",
    ["save_weights", "evaluate_population", *(pytest.param(stage, marks=pytest.mark.slow) for stage in SLOW)],
)
def test_a_run_interrupted_in_any_stage_is_finished_by_resuming_it(
    stage, whole, tmp_path, monkeypatch, curves
):
    with monkeypatch.context() as patched:
        patched.setattr(running, stage, interrupted)
        with pytest.raises(InterruptionError) as ended:
            run(FIELD, tmp_path / "run")
    assert ended.value.__notes__ == [f"To resume: {' '.join(cprl_command())} run {tmp_path / 'run'} --resume"]
    assert checkpoints_in(tmp_path / "run" / "checkpoints")
    assert resumed(FIELD, tmp_path / "run") == tmp_path / "run"
    assert_same(tmp_path / "run", whole)
    assert (tmp_path / "run" / "report.json").exists()


@pytest.mark.integration
def test_a_finished_run_that_is_resumed_says_so_and_stays_as_it_is(whole, tmp_path, capsys):
    before = contents(whole)
    resumed(FIELD, whole)
    assert f"{whole} is finished; with more --episodes it is extended" in capsys.readouterr().out
    assert contents(whole) == before
    copy = export_results(whole, tmp_path / "copy")
    resumed(FIELD, copy)
    assert f"{copy} is finished; it keeps no state of its training" in capsys.readouterr().out


@pytest.mark.integration
def test_a_run_that_another_process_finishes_while_agents_are_made_stays_as_it_is(
    whole, tmp_path, monkeypatch, capsys
):
    make_agents = running.make_agents
    with monkeypatch.context() as patch:
        patch.setattr(running, "write_evaluation", interrupted)
        with pytest.raises(InterruptionError):
            run(FIELD, tmp_path / "run")

    def slowly(*arguments, **options):
        made = make_agents(*arguments, **options)
        monkeypatch.setattr(running, "make_agents", make_agents)
        resumed(FIELD, tmp_path / "run", keep_checkpoint=False)
        return made

    monkeypatch.setattr(running, "make_agents", slowly)
    assert resumed(FIELD, tmp_path / "run") == tmp_path / "run"
    before = contents(tmp_path / "run")
    assert capsys.readouterr().out.count(f"{tmp_path / 'run'} is finished; ") == 1
    resumed(FIELD, tmp_path / "run")
    assert contents(tmp_path / "run") == before
    assert_same(tmp_path / "run", whole)


@pytest.fixture(scope="module")
def longer(tmp_path_factory):
    return run(replace(FIELD, episodes=9), tmp_path_factory.mktemp("longer") / "run")


@pytest.mark.integration
def test_a_finished_run_is_extended_bit_for_bit_and_its_earlier_results_are_kept(
    whole, longer, tmp_path, monkeypatch
):
    extended = shutil.copytree(whole, tmp_path / "extended")
    monkeypatch.setattr("sys.argv", f"cprl run {extended} --resume --episodes 9 --watch off".split())
    cli.main()
    assert_same(extended, longer)
    assert cprl.load(extended).experiment == replace(FIELD, episodes=9)
    assert repr(final(extended, "final-5")) == repr(final(whole))
    earlier = read_table(extended / "evaluation-5" / "trained.parquet")
    assert earlier.equals(read_table(whole / "evaluation" / "trained.parquet"))
    assert cprl.load(extended, weights="final-5").networks.keys() == cprl.load(extended).networks.keys()
    recipe = json.loads((extended / "recipe.json").read_text())
    assert [(part["episodes"], *part["versions"]) for part in recipe["extended"]] == [
        (5, *recipe["versions"])
    ]


@pytest.mark.slow
def test_an_extension_that_is_interrupted_is_resumed(whole, longer, tmp_path, monkeypatch):
    extended = shutil.copytree(whole, tmp_path / "extended")
    more = replace(FIELD, episodes=9)
    for stage in ("train", "save_weights", "evaluate_population"):
        with monkeypatch.context() as patched:
            patched.setattr(running, stage, interrupted)
            with pytest.raises(InterruptionError):
                run(more, extended, resume=True)
    assert cprl.load(extended).weights_from.name == "final.pt"
    run(more, extended, resume=True)
    assert_same(extended, longer)


@pytest.mark.integration
def test_a_run_without_a_checkpoint_says_that_it_begins_with_the_first_episode(
    whole, tmp_path, monkeypatch, capsys
):
    with monkeypatch.context() as patched:
        patched.setattr(running.Checkpointer, "after_step", Interrupted(at=40))
        with pytest.raises(InterruptionError):
            run(FIELD, tmp_path / "run")
    assert read_episodes(tmp_path / "run").num_rows > 0
    assert "No checkpoint yet" not in capsys.readouterr().out
    resumed(FIELD, tmp_path / "run")
    assert "No checkpoint yet: begins with the first episode\n" in capsys.readouterr().out
    assert_same(tmp_path / "run", whole)


class Interrupted:
    """In the place of a function: ends the process when it is called so often."""

    def __init__(self, at):
        self.left = at

    def __call__(self, *_):
        self.left -= 1
        if self.left == 0:
            raise InterruptionError


@pytest.mark.integration
def test_a_stopped_run_is_extended_too(longer, tmp_path, stopped, capsys):
    stopped(41, STOPPING, tmp_path / "run")
    capsys.readouterr()
    resumed(replace(STOPPING, episodes=9), tmp_path / "run")
    said = capsys.readouterr().out
    assert "Resuming from step 41" in said
    assert "No checkpoint yet" not in said
    assert_same(tmp_path / "run", longer)


@pytest.mark.integration
def test_stored_agents_play_with_the_weights_they_had_when_the_run_began(tmp_path, monkeypatch, stopped):
    monkeypatch.chdir(tmp_path)
    run(FIELD, Path("earlier"))
    among = replace(STOPPING, agents=[LEARNING, Frozen("earlier", 0)])
    run(among, Path("whole"))
    (played,) = json.loads(Path("whole/recipe.json").read_text())["frozen"].values()
    assert played == checksum(Path("earlier/checkpoints/final.pt"))
    stopped(31, among, Path("stopped"))
    resumed(replace(FIELD, episodes=9), Path("earlier"))
    assert checksum(Path("earlier/checkpoints/final.pt")) != played
    resumed(among, Path("stopped"))
    assert repr(final("stopped")) == repr(final("whole"))
    export_results(Path("whole"), Path("deep/er/exported"))
    before = final("earlier", "final-5")["replica_0/agent_0"]
    cprl.trust("own_parts:Stopping")
    for folder in ("whole", "stopped", "deep/er/exported"):
        weights = cprl.load(folder).agent(1).network.state_dict()
        assert all(torch.equal(weights[name], before[name]) for name in before), folder
    Path("earlier/checkpoints/final-5.pt").unlink()
    with pytest.raises(ValueError, match="earlier no longer has the weights that play in whole"):
        cprl.load("whole").agent(1)


@pytest.mark.integration
def test_what_cannot_be_extended_bit_for_bit_is_refused_before_anything_is_written(whole, tmp_path):
    bare = cprl.run(FIELD, tmp_path / "bare", watch="off")
    assert checkpoints_in(bare / "checkpoints") == []
    before = contents(bare)
    with pytest.raises(ValueError, match=r"keeps no state of its training to extend it from"):
        resumed(replace(FIELD, episodes=6), bare)
    assert contents(bare) == before
    seeing = run(replace(MEADOW, episodes=2), tmp_path / "seeing")
    with pytest.raises(ValueError, match="callback Bored, whose on_start sees the number of episodes"):
        resumed(replace(MEADOW, episodes=3), seeing)
    damaged = shutil.copytree(whole, tmp_path / "damaged")
    (ending,) = filter(is_ending, checkpoints_in(damaged / "checkpoints"))
    ending.write_bytes(ending.read_bytes()[:-1])
    with pytest.raises(ValueError, match=f"{ending.name} is damaged or was changed"):
        resumed(replace(FIELD, episodes=6), damaged)


@pytest.mark.integration
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"agents": [Learning(Custom("nowhere:Algorithm"))] * 2}, "nowhere"),
        ({"transforms": [Custom("nowhere:Transform")]}, "nowhere"),
        ({"loggers": [Custom("own_parts:NoLogger")]}, "NoLogger"),
    ],
)
def test_a_refused_run_leaves_nothing_behind(change, message, tmp_path):
    with pytest.raises((ValueError, TypeError), match=message):
        run(replace(FIELD, **change), tmp_path / "run")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_run_that_is_written_is_locked_by_name_until_its_process_dies(tmp_path):
    heard, say = os.pipe()
    child = os.fork()
    if child == 0:
        with RunLock(tmp_path):
            os.write(say, b"locked")
            signal.pause()
    os.read(heard, 6)
    with pytest.raises(RunLockedError, match=f"process {child} on {socket.gethostname()} since"):
        RunLock(tmp_path).__enter__()
    with pytest.raises(RunLockedError), Checkpointer(tmp_path, take_over=True):
        pass
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    assert (tmp_path / "run.lock").exists()
    with RunLock(tmp_path):
        assert json.loads((tmp_path / "run.lock").read_text())["pid"] == os.getpid()
    assert not (tmp_path / "run.lock").exists()


@pytest.mark.integration
def test_a_run_that_is_written_is_not_resumed_and_a_lock_of_another_host_is_taken_over(whole, tmp_path):
    stopped = copied(whole, tmp_path / "run")
    with RunLock(stopped):
        before = contents(stopped)
        with pytest.raises(RunLockedError, match="is being written by process"):
            resumed(FIELD, stopped)
        assert contents(stopped) == before
    (stopped / "run.lock").write_text('{"host": "elsewhere", "pid": 7, "started": "2026-11-22T10:00:00"}\n')
    before = contents(stopped)
    with pytest.raises(RunLockedError, match=r"locked by process 7 on elsewhere since .*--take-over"):
        resumed(FIELD, stopped)
    assert contents(stopped) == before
    resumed(FIELD, stopped, take_over=True)
    assert_same(stopped, whole)


@pytest.mark.integration
@pytest.mark.parametrize("again", [False, True], ids=["deleted", "made again"])
def test_a_deleted_run_ends_within_a_checkpoint_and_nothing_is_recreated(again, tmp_path, monkeypatch):
    monkeypatch.setattr(running, "Checkpointer", _often)
    monkeypatch.setenv("DELETE", f"{tmp_path / 'run'} {int(again)}")
    deleting = replace(STOPPING, callbacks=[Custom("own_parts:Deleting")])
    with pytest.raises(FileNotFoundError, match="the directory was deleted while the run was written"):
        run(deleting, tmp_path / "run")
    assert [path.name for path in tmp_path.rglob("*")] == (["run"] if again else [])


def _often(*arguments, **options):
    return Checkpointer(*arguments, every_s=1e-9, **options)


@pytest.mark.integration
def test_a_shorter_journal_falls_back_to_the_checkpoint_before(whole, tmp_path, monkeypatch, stopped, capsys):
    with monkeypatch.context() as patched:
        patched.setattr(running, "Checkpointer", _often)
        path = stopped(75, STOPPING, tmp_path / "run")
    newest = checkpoints_in(path / "checkpoints")[-1]
    rows = read_episodes(path).num_rows
    state = read_checkpoint(newest)
    state["callbacks"]["EpisodeTable"]["rows"] += 2
    torch.save(state, newest)
    newest.rename(newest.with_name(f"training-{state['steps']:012d}-{checksum(newest)}.pt"))
    resumed(STOPPING, path)
    assert f"Passed over: {path / 'episodes.arrows'} holds {rows} rows up to there" in capsys.readouterr().out
    assert read_episodes(path).equals(read_episodes(whole))


@pytest.mark.integration
def test_going_on_under_other_versions_is_said(whole, tmp_path, capsys):
    other = copied(whole, tmp_path / "run")
    recipe = json.loads((other / "recipe.json").read_text())
    recipe["versions"]["torch"] = "1.0"
    (other / "recipe.json").write_text(json.dumps(recipe))
    resumed(FIELD, other)
    assert "was begun under other versions" in (said := capsys.readouterr().err)
    assert "versions.torch was '1.0', is" in said


def test_empty_and_nan_weights_are_refused_by_name(whole, tmp_path):
    path = shutil.copytree(whole, tmp_path / "run")
    (path / "manifest.json").unlink()
    weights = final(path)

    def write(value, *lanes):
        for lane in lanes:
            for tensor in weights[lane].values():
                tensor.fill_(value)
        torch.save(weights if lanes else {}, path / "checkpoints" / "final.pt")

    write(torch.nan, "replica_1/agent_0")
    loaded = cprl.load(path)
    loaded.agent(0, replica=0)
    with pytest.raises(ValueError, match=r"final\.pt: the weights of replica_1/agent_0 are NaN or infinite"):
        loaded.agent(0, replica=1)
    write(torch.inf, "replica_0/agent_0")
    with pytest.raises(ValueError, match=r"final\.pt holds no weights of this run: all are NaN or infinite"):
        cprl.load(path)
    write(0)
    with pytest.raises(ValueError, match=r"final\.pt holds no weights of this run: it is empty"):
        cprl.load(path)


@pytest.mark.parametrize("name", ["../../other", "/etc/passwd", "..", ""])
def test_weights_are_named_inside_the_run(whole, name):
    with pytest.raises(ValueError, match=r"weights is .*"):
        cprl.load(whole, weights=name)


@pytest.mark.integration
def test_files_are_written_as_the_umask_says(tmp_path):
    before = os.umask(0o027)
    try:
        path = run(FIELD, tmp_path / "run")
    finally:
        os.umask(before)
    modes = {name: (path / name).stat().st_mode & 0o777 for name in contents(path)}
    assert modes == dict.fromkeys(modes, 0o640)


@pytest.mark.integration
@pytest.mark.parametrize("name", ["checkpoints/final.pt", "evaluation/trained.parquet"])
def test_a_run_that_lost_a_file_of_its_manifest_is_refused_by_that_file(name, whole, tmp_path):
    lost = shutil.copytree(whole, tmp_path / "run")
    (lost / name).unlink()
    longer = replace(FIELD, episodes=FIELD.episodes + 1)
    before = contents(lost)
    for use in (
        lambda: cprl.load(lost),
        lambda: cprl.evaluate_run(lost, cprl.Fresh(episodes=1)),
        lambda: resumed(FIELD, lost),
        lambda: resumed(longer, lost),
        lambda: export_results(lost, tmp_path / "results"),
    ):
        with pytest.raises((ValueError, FileNotFoundError), match=name):
            use()
    assert contents(lost) == before
    assert not (tmp_path / "results").exists()


def test_an_ended_run_without_its_weights_is_never_played_from_an_older_checkpoint(whole, tmp_path):
    lost = shutil.copytree(whole, tmp_path / "run")
    (lost / "checkpoints" / "final.pt").unlink()
    (lost / "manifest.json").unlink()
    with pytest.raises(ValueError, match=r"final\.pt"):
        cprl.load(lost)


LINKS = ("run.lock", "episodes.arrows", "report.json", "recipe.json", "run.rrd", "checkpoints/final.pt")


@pytest.mark.integration
@pytest.mark.parametrize("name", [*LINKS, "checkpoints", "evaluation", "figures", "logs"])
def test_a_run_with_a_link_out_of_it_is_refused_by_the_link_and_what_it_leads_to_stays(name, whole, tmp_path):
    begun, outside = copied(whole, tmp_path / "run"), tmp_path / "outside"
    if (begun / name).exists():
        (begun / name).rename(outside)
    elif name != "report.json":  # with which the run would be finished, and nothing written
        outside.write_text("a file of mine")
    (begun / name).symlink_to(outside)
    before = contents(tmp_path)
    with pytest.raises(ValueError, match=f"{name} is a symbolic link"):
        resumed(FIELD, begun)
    assert contents(tmp_path) == before


@pytest.mark.integration
def test_a_killed_run_with_a_backup_by_hard_links_is_resumed_and_the_backup_stays_as_it_was(whole, tmp_path):
    """As by `cp -al`; nothing is written through a link to a file of somebody else, either."""
    begun, backup = copied(whole, tmp_path / "run"), tmp_path / "backup"
    EpisodeTable(begun / "episodes.parquet", resumable=True)
    (begun / "run.lock").write_text("a file of mine")
    shutil.copytree(begun, backup, copy_function=os.link)
    before = contents(backup)
    assert {"episodes.arrows", "run.lock", "recipe.json", "checkpoints/final.pt"} <= set(before)
    resumed(FIELD, begun)
    assert contents(backup) == before
    assert (begun / "report.json").exists()
    assert not (begun / "run.lock").exists()


def test_a_lock_with_a_hard_link_still_keeps_others_out(tmp_path):
    with RunLock(tmp_path):
        os.link(tmp_path / "run.lock", tmp_path / "backup.lock")
        with pytest.raises(RunLockedError, match=str(os.getpid())), RunLock(tmp_path):
            pass
    assert not (tmp_path / "run.lock").exists()
    (tmp_path / "backup.lock").write_text("a file of mine")
    os.link(tmp_path / "backup.lock", tmp_path / "run.lock")
    with RunLock(tmp_path), pytest.raises(RunLockedError), RunLock(tmp_path):
        pass
    assert (tmp_path / "backup.lock").read_text() == "a file of mine"


def test_a_run_that_is_reached_through_a_link_and_links_within_it_are_no_obstacle(tmp_path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "runs").symlink_to(tmp_path / "disk")
    begun = start_run(tmp_path / "runs" / "run", "run", FIELD.to_recipe)
    (begun / "my_recipe.json").symlink_to(begun / "recipe.json")
    (begun / "logs" / "wandb").mkdir(parents=True)
    (begun / "logs" / "wandb" / "debug.log").symlink_to(tmp_path / "debug.log")
    with RunLock(begun):
        assert (tmp_path / "disk" / "run" / "run.lock").exists()


def test_results_are_not_exported_through_a_link(whole, tmp_path):
    (tmp_path / "results").mkdir()
    (tmp_path / "outside").mkdir()
    (tmp_path / "results" / "evaluation").symlink_to(tmp_path / "outside")
    with pytest.raises(ValueError, match="evaluation is a symbolic link"):
        export_results(whole, tmp_path / "results")
    assert contents(tmp_path / "outside") == {}


def test_a_film_is_not_written_through_a_link_to_a_file_that_is_not_there(tmp_path):
    (tmp_path / "film.rrd").symlink_to(tmp_path / "outside.rrd")
    with pytest.raises(FileExistsError, match=r"film\.rrd"):
        refuse_to_write_over(tmp_path / "film.rrd")


def test_two_writers_of_a_file_do_not_notice_each_other(tmp_path):
    path = tmp_path / "table"

    def write_slowly(file):
        file.write(b"fir")
        write_atomically(path, lambda other: other.write(b"second"))
        assert path.read_bytes() == b"second"
        file.write(b"st")

    write_atomically(path, write_slowly)
    assert path.read_bytes() == b"first"
    assert [*tmp_path.iterdir()] == [path]


def test_what_killed_processes_left_half_written_is_removed_by_the_next_one(tmp_path):
    run = tmp_path / "run"
    left = [run / f"recipe.json.{8 * '0'}.partial", run / "checkpoints" / f"training.{8 * 'f'}.partial"]
    left[1].parent.mkdir(parents=True)
    for path in [*left, run / "foreign.partial"]:
        path.touch()
    with Checkpointer(run):
        assert not any(path.exists() for path in left)
    assert (run / "foreign.partial").exists()


class State:
    """Stands for a training."""

    is_ending, is_over, is_finite = False, False, True

    def __init__(self, steps=0):
        self.steps, self.loaded = steps, None

    def state_dict(self):
        return {"steps": self.steps, "numbers": torch.arange(5)}

    def load_state_dict(self, state):
        self.steps, self.loaded = state["steps"], state


def test_the_newest_two_are_kept_and_the_newest_is_gone_on_from(tmp_path):
    checkpoints = Checkpointer(tmp_path)
    for steps in (3, 20, 100):
        checkpoints.save(State(steps))
    paths = checkpoints_in(tmp_path / "checkpoints")
    assert [read_checkpoint(path)["steps"] for path in paths] == [20, 100]
    training = State()
    checkpoints.restore(training)
    assert training.steps == 100
    checkpoints.done()
    assert checkpoints_in(tmp_path / "checkpoints") == []


def test_it_saves_at_its_interval_and_not_before(tmp_path):
    often, seldom = Checkpointer(tmp_path / "a", every_s=1e-9), Checkpointer(tmp_path / "b", every_s=1000)
    (tmp_path / "a").mkdir()
    for steps in (1, 2):
        often.after_step(State(steps))
        seldom.after_step(State(steps))
    assert len(checkpoints_in(tmp_path / "a" / "checkpoints")) == 2
    assert checkpoints_in(tmp_path / "b" / "checkpoints") == []
    over = State(3)
    over.is_over = True
    long = Checkpointer(tmp_path / "c", every_s=1000, keep_ending=False)
    long.run.mkdir()
    long.after_step(over)
    assert checkpoints_in(long.folder) == [], "seconds of training"
    long._saved -= 61
    long.after_step(over)
    assert len(checkpoints_in(long.folder)) == 1, "a minute that an interrupted evaluation would repeat"
    with pytest.raises(ValueError, match="every_s is 0"):
        Checkpointer(tmp_path, every_s=0)


def test_a_spoilt_checkpoint_is_refused_by_name_and_the_one_before_taken(tmp_path):
    checkpoints = Checkpointer(tmp_path)
    first, second = checkpoints.save(State(1)), checkpoints.save(State(2))
    content = second.read_bytes()
    second.write_bytes(content[:-10])
    with pytest.raises(ValueError, match=rf"{second.name} is damaged or was changed: its checksum is"):
        read_checkpoint(second)
    training = State()
    checkpoints.restore(training)
    assert training.steps == 1
    first.write_bytes(first.read_bytes().replace(b"numbers", b"nombres"))
    with pytest.raises(ValueError, match=f"no checkpoint can be read: .*{second.name}.*{first.name}"):
        checkpoints.restore(State())


def test_a_foreign_file_is_refused_and_none_of_its_code_is_run(tmp_path):
    class Harmful:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "harm"),)

    checkpoints = Checkpointer(tmp_path)
    state = State(1)
    state.state_dict = lambda: {"steps": 1, "harm": Harmful()}
    path = checkpoints.save(state)
    with pytest.raises(ValueError, match=f"{path.name} is not the state of a training"):
        read_checkpoint(path)
    assert not (tmp_path / "harm").exists()
    with pytest.raises(ValueError, match=r"notes\.pt is not a checkpoint"):
        read_checkpoint(tmp_path / "notes.pt")


def test_a_full_disk_leaves_the_checkpoints_before(tmp_path, monkeypatch):
    checkpoints = Checkpointer(tmp_path)
    checkpoints.save(State(1))

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(torch, "save", full)
    with pytest.raises(OSError, match="No space left"):
        checkpoints.save(State(2))
    (path,) = (tmp_path / "checkpoints").iterdir()
    assert read_checkpoint(path)["steps"] == 1


def test_few_numbers_of_rollout_learners_are_drawn_ahead():
    spaces = Spaces(agents=2, observation_shape=(3, 2, 2), actions=3)

    algorithm = PPO(settings=RolloutSettings(hidden_cells=(4,)))
    learner = make_learner(algorithm, spaces, agents=(0, 1), replicas=1, engine="eager", seed=4)
    seeds = lane_seeds(4, replicas=range(1), agents=(0, 1), purpose=Purpose.SAMPLING)
    many = LaneRng(seeds, 250, ahead=DRAWN_AHEAD)
    for _ in range(70):  # more than are drawn ahead
        assert torch.equal(learner.memory.rng.next(), many.next())
    assert learner.state_dict()["memory"]["order"]["numbers"].numel() <= 2 * 2**14


def test_a_lock_file_that_says_nothing_is_taken(tmp_path):
    lock = tmp_path / "run.lock"
    lock.write_text("[" * 4000)
    with RunLock(tmp_path):
        assert json.loads(lock.read_text())["pid"] == os.getpid(), "and says whose it is now"
    assert not lock.exists()
