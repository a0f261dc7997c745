"""Any TorchRL game is measured, kept, watched and evaluated; what it does not report is left out by name."""

import io
import re

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from corridor import Corridor, play
from matrix_game import MatrixGame, tit_for_tat
from places import ROOT
from recall_game import Recall
from recordings import column
from rerun.chunk import RrdReader
from rich.console import Console
from torchrl.data import Bounded
from torchrl.envs import (
    Compose,
    GymWrapper,
    ObservationNorm,
    RenameTransform,
    RewardSum,
    StepCounter,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs

from cprl import CommonsEnv, Game, Rules, maps
from cprl.envs import make_env, spaces_of
from cprl.envs.unwrap import agent_names
from cprl.measuring import EpisodeTracker
from cprl.measuring.playing import evaluate
from cprl.measuring.registry import (
    ENTRIES_OF_FIELDS,
    METRICS,
    OPTIONAL_ENTRIES,
    SOCIAL_METRICS,
    compute_metrics,
    left_out_note,
    metrics_for,
    reported_by,
)
from cprl.measuring.statistics import estimates
from cprl.measuring.table import labelled, store_agent_names, where
from cprl.policies.actors import RandomActor
from cprl.policies.joint_policy import JointPolicy
from cprl.runs.curves import curves_of
from cprl.runs.episodes import COLUMNS, LEFT_OUT, EpisodeTable, read_episodes, table_of
from cprl.runs.schedule import Schedule
from cprl.terminal.figures import training_curve
from cprl.terminal.progress import ProgressBar
from cprl.terminal.summary import comparison_table, summarise
from cprl.training.training import StepCollector
from cprl.viewer.callback import ViewerCallback

GAME = Game(
    map=maps.parse(".A>.A\n.A.A.\n..<.A"),
    rules=Rules(regrow_prob=(0.0, 0.1), window_rows=3, window_columns=5, episode_steps=20),
)
NO_HARVEST = "collective_return, efficiency, equality, sustainability, harvest (the game reports no harvest)"


def at_random():
    return JointPolicy([RandomActor(8), RandomActor(8, seed=1)])


STORED = metrics_for(OPTIONAL_ENTRIES)[:-1]
"""Without the stock that is left, which is a total."""


def told(episodes):
    return [repr({**vars(episode), "world": None, "episode": None}) for episode in episodes]


def by_policy(**played):
    """The table of episodes of one replica by policy."""
    tables = (labelled(table_of(episodes), policy=policy) for policy, episodes in played.items())
    return pa.concat_tables(tables)


def test_what_a_game_of_torchrl_reports_is_read_from_its_specs():
    check_env_specs(MatrixGame(2, with_harvest=True))
    assert reported_by(MatrixGame(2)) == ()
    assert reported_by(MatrixGame(2, with_harvest=True)) == ("harvest",)
    assert reported_by(TransformedEnv(CommonsEnv(GAME, 1), StepCounter())) == OPTIONAL_ENTRIES


def test_each_metric_needs_what_is_said_and_nothing_else():
    of_entry = {"harvest": ("harvest", "harvest_steps", "harvest_time"), "in_play": ("in_play_steps",)}
    rng = np.random.default_rng(1)
    totals = {name: rng.random((4, 2)) for names in of_entry.values() for name in names}
    steps = np.full(4, 9.0)
    whole = compute_metrics({"steps": steps, **totals})
    assert tuple(whole) == STORED
    for given in ((), ("harvest",), ("in_play",)):
        known = {name: totals[name] for entry in given for name in of_entry[entry]}
        part = compute_metrics({"steps": steps, **known})
        assert tuple(part) == metrics_for(given)
        assert all(np.array_equal(part[name], whole[name]) for name in part)


def test_what_the_docs_say_is_left_out_is_what_needs_the_entry():
    text = (ROOT / "docs" / "metrics.md").read_text()
    rows = dict(re.findall(r'^\| "(\w+)" \| (.*) \|$', text, re.MULTILINE))
    needs = {**{name: METRICS[name].entries for name in SOCIAL_METRICS}, **ENTRIES_OF_FIELDS}
    words = {name: set(re.findall(r"\w+", row)) for name, row in rows.items()}
    assert {entry: words[entry] & set(needs) for entry in rows} == {
        entry: {name for name, entries in needs.items() if entry in entries} - {"tagged_by"}
        for entry in OPTIONAL_ENTRIES
    }, "tagged_by is told as who tagged whom"


class RecallByWorld(Recall):
    """Takes the number of the first world, by which cues differ here as by the seed."""

    def make(self, worlds, seed, device, first_world):
        env = super().make(worlds, seed, device)
        env.first_world = first_world
        return env


def test_a_game_gets_the_number_of_the_first_world_if_its_make_takes_it_else_another_seed():
    plain = make_env(Recall(), worlds=2, seed=3, first_world=4)
    assert plain.seed == 7
    by_world = make_env(RecallByWorld(), worlds=2, seed=3, first_world=4)
    assert (by_world.seed, by_world.first_world) == (3, 4)
    with pytest.raises(ValueError, match=r"seed \+ first_world is 18446744073709551616"):
        make_env(Recall(), seed=2**64 - 1, first_world=1)


def test_a_game_that_reports_nothing_but_rewards_has_returns_and_steps():
    # Agent 0 cooperates once, then both defect: 0 + 4 x 1, 4.5 + 4 x 1; the second world has one turn more.
    first, second = play(MatrixGame(2), tit_for_tat, 6)
    assert (first.return_.tolist(), first.steps, first.terminated) == ([4.0, 8.5], 5, False)
    assert (second.return_.tolist(), second.steps, second.world) == ([5.0, 9.5], 6, 1)
    assert first.metrics == {"survival_steps": 5.0}
    assert [getattr(first, name) for name in ENTRIES_OF_FIELDS] == [None] * len(ENTRIES_OF_FIELDS)
    assert first.reported == ()
    assert first.outcome == "returns: 4, 8.5"
    line = left_out_note(first.reported)
    assert line.startswith(
        f"left out: {NO_HARVEST}; peace, peacefulness, in_play_steps (the game reports no in_"
    )
    assert line.endswith("; stock_left, depletion_step (the game reports no stock)")


def test_a_game_with_a_harvest_has_the_metrics_of_harvest():
    (episode,) = play(MatrixGame(1, with_harvest=True), tit_for_tat, 5)
    assert episode.harvest.tolist() == [4.0, 8.5]
    assert tuple(episode.metrics) == metrics_for(["harvest"])
    assert episode.metrics["collective_return"] == 12.5
    assert episode.reported == ("harvest",)
    assert left_out_note(OPTIONAL_ENTRIES) == ""


@pytest.mark.parametrize("with_harvest", [False, True])
def test_a_tracker_goes_on_exactly_from_its_state(with_harvest):
    env, tracker, other = MatrixGame(2, with_harvest=with_harvest), EpisodeTracker(2, 2), EpisodeTracker(2, 2)
    assert list(tracker.state_dict()) == ["episode"], "before the first batch"
    batches = [batch for batch, _ in zip(StepCollector(env, tit_for_tat), range(6), strict=False)]
    for batch in batches[:3]:
        tracker.add(batch)
    other.load_state_dict(tracker.state_dict())
    ends = [[told(each.add(batch)) for batch in batches[3:]] for each in (tracker, other)]
    assert ends[0] == ends[1]
    assert sum(map(len, ends[0])) == 2
    other.load_state_dict(EpisodeTracker(2, 2).state_dict())
    assert other.reported is None


def test_a_batch_that_lacks_what_all_have_or_the_first_had_is_refused():
    whole, bare = (
        next(iter(StepCollector(MatrixGame(1, with_harvest=has), tit_for_tat))) for has in (True, False)
    )
    tracker = EpisodeTracker(1, 2)
    tracker.add(whole)
    for each, batch, message in (
        (tracker, bare, r"the batch lacks \(next, agents, harvest\)"),
        (EpisodeTracker(1, 2), bare.exclude(("next", "agents", "reward")), r"\(next, agents, reward\)"),
        (EpisodeTracker(1, 2), bare.exclude("done"), r"lacks \(done\)"),
    ):
        with pytest.raises(ValueError, match=message):
            each.add(batch)


def test_its_table_has_the_columns_that_there_are_and_says_what_is_left_out(tmp_path):
    with EpisodeTable(tmp_path / "episodes.parquet") as table:
        episodes = play(MatrixGame(2), tit_for_tat, 13, callbacks=[table])
        (other,) = play(MatrixGame(1, with_harvest=True), tit_for_tat, 5)
        with pytest.raises(ValueError, match=r"has the extra columns \['collective_return'"):
            table.add(other)
        going_on = read_episodes(tmp_path)
    kept = read_episodes(tmp_path)
    columns = ["replica", "episode", "agent", "return", "steps", "terminated", "survival_steps"]
    assert kept.column_names == columns
    assert kept.equals(going_on)
    assert pq.read_table(tmp_path / "episodes.parquet").equals(kept)
    assert kept.schema.metadata[LEFT_OUT].decode() == left_out_note(())
    assert kept["return"].to_pylist() == [4.0, 8.5, 5.0, 9.5, 4.0, 8.5, 5.0, 9.5]
    curves = curves_of(tmp_path)
    assert sorted(curves) == ["income", "return_0", "return_1", "survival_steps"]
    assert curves["income"].tolist() == [[12.5, 12.5], [14.5, 14.5]]
    assert curves["return_1"].tolist() == [[8.5, 8.5], [9.5, 9.5]]
    joined = by_policy(a=episodes[:2], b=episodes[2:])
    assert joined.column_names == ["policy", *columns]


def test_the_table_of_a_commons_has_all_columns():
    (episode,) = evaluate(CommonsEnv(GAME, 1), at_random())
    table = table_of([episode])
    names = [
        (name, kind) for name, kind in COLUMNS.items() if name not in ("wanted_return", "world")
    ]  # of trainings
    names += [(name, pa.float64()) for name in (*STORED, "yield_share")]
    assert table.schema.equals(pa.schema(names), check_metadata=True)


def test_a_game_that_must_not_be_stepped_when_it_has_ended_is_evaluated():
    episodes = evaluate(MatrixGame(3), tit_for_tat)
    ends = [(episode.world, episode.episode, episode.steps) for episode in episodes]
    assert ends == [(0, 0, 5), (1, 0, 6), (2, 0, 7)]
    measures = estimates(table_of(episodes))
    assert measures.numbers == ["income", "survival_steps"]
    assert measures["survival_steps"].value == 6.0


def test_an_environment_whose_rewards_are_not_of_agents_in_worlds_is_refused():
    with pytest.raises(ValueError, match=r"the environment has batch size \[\]"):
        evaluate(GymWrapper(Corridor()), tit_for_tat)
    env = TransformedEnv(MatrixGame(2), RenameTransform([("agents", "reward")], ["reward"]))
    with pytest.raises(ValueError, match=r'\("agents", "reward"\) is None'):
        evaluate(env, tit_for_tat)


def greedy_right(tensordict):
    """A policy without chance: everyone walks by what it sees."""
    seen = tensordict["agents", "observation"].to(torch.float32).flatten(2).sum(-1)
    return tensordict.set(("agents", "action"), seen.round().long() % 7)


def transformed(worlds):
    """A CommonsEnv whose transforms keep something from step to step."""
    paid = RewardSum(in_keys=[("agents", "reward")], out_keys=[("agents", "paid")], reset_keys=["_reset"])
    return TransformedEnv(CommonsEnv(GAME, worlds, seed=3), Compose(paid, StepCounter()))


def test_transforms_change_nothing_that_is_evaluated():
    plain = evaluate(CommonsEnv(GAME, 5, seed=3), greedy_right)
    assert told(evaluate(transformed(5), greedy_right)) == told(plain)
    sums = []

    def summing(tensordict):
        sums.append(tensordict["agents", "paid"][:, :, 0].clone())
        return greedy_right(tensordict)

    (episode,) = evaluate(transformed(1), summing)
    assert torch.stack(sums).diff(dim=0).ge(0).all()
    assert len(sums) == episode.steps
    assert sums[-1].sum() > 0, "RewardSum goes on from step to step"


def test_a_clock_of_a_transform_ends_episodes():
    env = TransformedEnv(MatrixGame(2, steps=50), StepCounter(max_steps=7))
    assert [episode.steps for episode in evaluate(env, tit_for_tat)] == [7, 7]


def test_a_recording_of_it_names_its_agents_has_metrics_and_returns_and_says_what_is_left_out(tmp_path):
    env = MatrixGame(2)
    env.group_map = {"agents": ["row", "column"]}
    wrapped = TransformedEnv(env, StepCounter())
    with ViewerCallback(tmp_path, wrapped, title="matrix", episodes=2) as viewer:
        play(wrapped, tit_for_tat, 6, callbacks=[viewer])
        state = viewer.state_dict()
    with ViewerCallback(tmp_path, wrapped, title="matrix", episodes=2) as second:
        second.load_state_dict(state)
    path = tmp_path / "run.rrd"
    events = [text[0] for text in column(path, "log", "TextLog:text")[1]]
    assert events[0] == "matrix begins"
    line = "; ".join(text for text in events if "left out" in text or "(the game reports no" in text)
    assert NO_HARVEST.replace(" (the", ", new bests, the Lorenz curve (the") in line
    assert "who tagged whom" in line
    assert line.endswith("the board and what agents see (the game reports no board)")
    logged = {chunk.entity_path.strip("/") for chunk in RrdReader(path).stream()}
    assert not {name for name in logged if name.startswith(("world", "windows", "phase", "tags"))}
    assert {name for name in logged if name.startswith("social/")} == {"social/survival_steps"}
    assert column(path, "row/return", "Scalars:scalars", "episode") == ([0], [[4.5, 4.5]])
    assert column(path, "row/loss", "Scalars:scalars")[1] == [[0.5]]
    assert column(path, "social/survival_steps", "Scalars:scalars")[1] == [[5.0, 6.0, 5.5, 5.5]]


def test_under_transforms_windows_show_what_the_agents_of_the_game_observe(tmp_path):
    torch.manual_seed(0)
    shown = {}
    for name in ("bare", "transformed"):
        env = CommonsEnv(GAME, 1, seed=3)
        norm = ObservationNorm(0.0, 255.0, in_keys=[("agents", "observation")], standard_normal=True)
        played = env if name == "bare" else TransformedEnv(env, norm)
        path = tmp_path / name / "run.rrd"
        with ViewerCallback(path.parent, played, title="run", episodes=9) as viewer:
            play(played, at_random(), 30, callbacks=[viewer])
        shown[name] = {
            entity: column(path, entity, "SegmentationImage:buffer") for entity in ("windows", "world/board")
        }
        assert not [text for text in column(path, "log", "TextLog:text")[1] if "left out" in text[0]]
    assert len(shown["bare"]["windows"][0]) >= 19
    assert str(shown["bare"]) == str(shown["transformed"])


def test_the_terminal_shows_it_too(tmp_path, monkeypatch):
    monkeypatch.setattr("cprl.terminal.progress._LINE_PERIOD_S", 0.0)
    output = io.StringIO()
    console = Console(file=output, width=200)
    with (
        EpisodeTable(tmp_path / "episodes.parquet") as table,
        ProgressBar(Schedule(episodes=9), replicas=2, console=console) as bar,
    ):
        episodes = play(MatrixGame(2), tit_for_tat, 12, callbacks=[table, bar])
    assert "return 12.5" in output.getvalue()
    played = by_policy(random=episodes, trained=episodes)
    figure = training_curve(tmp_path, title="matrix", random=where(played, policy="random"))
    assert figure.stat().st_size > 10_000
    summarise(tmp_path, title="matrix", played=played, console=console)
    text = output.getvalue()
    assert text.count("left out: collective_return") == 1
    assert re.search(r"survival, steps\s*│\s*5\.\d+ │", text)
    assert not re.search(r"│ (equality|stock left|sustainability|collective)", text)


def test_the_table_of_an_evaluation_says_what_is_left_out():
    episodes = evaluate(MatrixGame(2), tit_for_tat)
    played = by_policy(trained=episodes, random=episodes)
    table = comparison_table(played, "")
    assert table.note.startswith("left out: collective_return")
    returns = ["agent 0: return", "agent 1: return"]
    rows = ["income of all agents together", "survival, steps", *returns, "episodes"]
    assert [name for name, *_ in table.rows] == rows
    assert "One replica: no interval." in table.note


def test_actions_of_numbers_are_refused_by_the_name_of_their_entry():
    env = CommonsEnv(Game(map=maps.parse(">.A<"), rules=Rules()), 1, seed=0)
    spec = env.full_action_spec.clone()
    spec["agents", "action"] = Bounded(-1, 1, shape=(1, 2, 1), dtype=torch.float32)
    env.full_action_spec = spec
    with pytest.raises(ValueError, match=r'\("agents", "action"\)'):
        spaces_of(env)


def test_a_page_calls_agents_what_their_game_calls_them():
    env = MatrixGame(2, steps=3)
    env.group_map = {"agents": ["ann", "bob"]}
    played = table_of(evaluate(env, tit_for_tat), [0, 1])
    tables = [labelled(played, policy=policy) for policy in ("trained", "random")]
    page = comparison_table(store_agent_names(pa.concat_tables(tables), agent_names(env)), "")
    names = [row[0] for row in page.rows]
    assert {"ann: return", "bob: return"} <= set(names)
    assert not [name for name in names if "agent 0" in name]
    unnamed = comparison_table(pa.concat_tables(tables), "")
    assert "agent 0: return" in [row[0] for row in unnamed.rows]
