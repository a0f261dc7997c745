"""What is measured of institutions: metrics worked by hand, what a tracker keeps, the table, the series."""

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st
from random_agents import random_agents
from torchrl.envs import StepCounter, TransformedEnv
from torchrl.envs.utils import RandomPolicy
from written_episodes import all_written_out, turn

from cprl import CommonsEnv, Game, Observation, Rules, maps
from cprl.institutions import (
    COUNT_NAMES,
    Boundaries,
    ClosedSeason,
    Governor,
    GraduatedSanctions,
    Levies,
    Mediation,
    Monitoring,
    Punishment,
    Quota,
    Sanctioner,
    Tax,
    Vote,
)
from cprl.institutions.law import INSTITUTION_KINDS
from cprl.measuring import EpisodeTracker, social
from cprl.measuring.playing import evaluate
from cprl.measuring.registry import (
    INSTITUTION_ENTRIES,
    METRICS,
    OPTIONAL_ENTRIES,
    compute_metrics,
    left_out_note,
    metrics_for,
)
from cprl.measuring.series import numbers_of
from cprl.measuring.statistics import estimates
from cprl.measuring.table import all_metrics
from cprl.runs.curves import as_curves
from cprl.runs.episodes import (
    INSTITUTION_COLUMNS as COLUMNS,
    EpisodeTable,
    read_episodes,
    stored_episodes,
    table_of,
)
from cprl.training import Schedule, train

NAN = float("nan")
EVERYTHING = (*OPTIONAL_ENTRIES, *INSTITUTION_ENTRIES)
GROUPS = ((0, 1), (2, 3))
# Four agents in one episode of 40 steps.
HARVEST = np.array([6.0, 2.0, 4.0, 0.0])
FINES = np.array([2.0, 0.0, 1.0, 0.0])
TRANSFERS = np.array([0.0, 1.0, 0.0, 2.0])
IN_PLAY = np.array([10, 10, 8, 4])
TAGS = np.array([2, 1, 1, 0])
OF_LAW = [
    name
    for name, metric in METRICS.items()
    if metric.is_of_institutions and "objective" not in metric.needs  # which games with a governor have
]
OF_GROUPS = {name for name in OF_LAW if name.endswith(("_within", "_between"))}
COUNTED = {
    "own_bites": np.array([5, 2, 3, 0]),
    "foreign_bites": np.array([1, 0, 1, 0]),
    "trespasses": np.array([2, 0, 3, 0]),
    "excess_bites": np.array([1, 0, 0, 0]),
    "closed_bites": np.array([0, 0, 2, 0]),
    "unjust_tags": np.array([1, 0, 0, 0]),
    "violations": np.array([3, 0, 5, 0]),
    "detections": np.array([2, 0, 2, 0]),
    "sanctions": np.array([2, 0, 1, 0]),
    "returns_to_violation": np.array([1, 0, 3, 0]),
}
BY_HAND = {
    "institutions/fines": 3.0,
    "institutions/transfers": 3.0,
    "institutions/violations": 8.0,
    "institutions/violations_per_step": 0.25,  # 8 / (10 + 10 + 8 + 4)
    "institutions/trespasses": 5.0,
    "institutions/excess_bites": 1.0,
    "institutions/closed_bites": 2.0,
    "institutions/own_share_of_bites": 10 / 12,
    "institutions/detection_rate": 0.5,  # 4 of 8
    "institutions/recidivism": 0.5,  # (1 + 3) of 8
    "institutions/sanctions_per_violation": 0.375,  # 3 / 8
    "institutions/unjust_share_of_tags": 0.25,  # 1 of 4
    # net incomes 4, 3, 3, 2: gaps of pairs 1 + 1 + 2 + 0 + 1 + 1 = 6, twice; 1 - 12 / (2 * 4 agents * 12)
    "income_equality": 0.875,
    # (6, 2): 1 - 8 / (2 * 2 * 8) = 3/4; (4, 0): 1 - 8 / (2 * 2 * 4) = 1/2
    "institutions/equality_within": 0.625,
    "institutions/equality_between": 5 / 6,  # means 4 and 2: 1 - 4 / (2 * 2 * 6)
    # (4, 3): 1 - 2 / (2 * 2 * 7) = 13/14; (3, 2): 1 - 2 / (2 * 2 * 5) = 9/10
    "institutions/income_equality_within": (13 / 14 + 9 / 10) / 2,
    "institutions/income_equality_between": 11 / 12,  # means 3.5 and 2.5: 1 - 2 / (2 * 2 * 6)
}


def whole(**changes):
    given = {
        "harvest": HARVEST,
        "fines": FINES,
        "transfers": TRANSFERS,
        **COUNTED,
        "in_play_steps": IN_PLAY,
        "tags": TAGS,
        "groups": GROUPS,
    }
    found = compute_metrics({**given, **changes})
    return {name: found[name] for name in OF_LAW if name in found}


def test_each_metric_is_what_we_work_out_by_hand():
    metrics = whole()
    assert {name: value.item() for name, value in metrics.items()} == pytest.approx(BY_HAND, rel=1e-15)
    assert set(metrics) == set(OF_LAW) == set(BY_HAND)
    assert all(value.dtype == np.float64 and value.shape == () for value in metrics.values())


def test_batch_axes_come_through():
    twice = {"harvest": np.stack([HARVEST, 2 * HARVEST]), "fines": np.stack([FINES, FINES])}
    twice["transfers"] = np.stack([TRANSFERS, TRANSFERS])
    found = whole(**twice, **dict.fromkeys((*COUNTED, "in_play_steps", "tags")))
    assert {value.shape for value in found.values()} == {(2,)}
    assert found["income_equality"][0].item() == BY_HAND["income_equality"]
    assert found["institutions/equality_within"].tolist() == pytest.approx([0.625, 0.625]), (
        "no matter in which unit"
    )


def test_where_nothing_happened_shares_are_undefined_and_totals_are_zero():
    entries = ("harvest", "fines", "transfers", "in_play_steps", "tags", *COUNT_NAMES)
    found = whole(**dict.fromkeys(entries, np.zeros(4)))
    totals = {"fines", "transfers", "violations", "trespasses", "excess_bites", "closed_bites"}
    totals = {f"institutions/{name}" for name in totals}
    assert {name for name, value in found.items() if value == 0} == totals
    assert all(np.isnan(value) for name, value in found.items() if name not in totals)


def test_edges_of_equality():
    harvest = np.array([6.0, 2.0, 0.0, 0.0])
    found = whole(harvest=harvest)
    within = found["institutions/equality_within"].item()
    assert within == 0.75, "a group without income is left out of the mean"
    assert np.isnan(social.equality(harvest[list(GROUPS[1])]))
    assert found["institutions/equality_between"].item() == 0.5, "means 4 and 0: one of two has everything"
    assert np.isnan(social.equality([3.0, -1.0])), "an income below zero"
    assert social.equality([3.0, 3.0]).item() == 1
    paid = np.full(10, np.float32(0.1), np.float64).sum()  # 1.0000000149, a tenth paid ten times in float32
    assert social.incomes_of(np.ones(1), [paid], np.zeros(1)).tolist() == [0.0]


@settings(max_examples=50, deadline=None)
@given(st.lists(st.integers(0, 50), min_size=1, max_size=6), st.integers(1, 9))
def test_without_payments_and_in_one_group_of_all_equality_is_that_of_the_harvest(apples, unit):
    harvest = np.array(apples, np.float64) / unit
    none = np.zeros_like(harvest)
    of_income = social.equality(social.incomes_of(harvest, none, none))
    within = social.equality_within(harvest, [range(len(apples))])
    wanted = social.equality(harvest)
    assert np.isnan(wanted) == (not any(apples))
    assert np.nan_to_num(of_income, nan=-1) == np.nan_to_num(within, nan=-1) == np.nan_to_num(wanted, nan=-1)


def paying(*, worlds=1, in_force=None, counted=None, **entries):
    """A turn of `test_episodes.turn` with the entries of institutions, which nobody breaks or pays but for
    what is said; counts are (name, agent): number of the first world."""
    own = {name: entries.pop(name, [[0, 0]] * worlds) for name in ("fines", "transfers", "violated")}
    batch = turn(worlds=worlds, **entries)
    agents = batch["next", "agents"]
    for name, value in own.items():
        agents[name] = torch.tensor(value, dtype=torch.bool if name == "violated" else torch.float32)
    agents["counts"] = torch.zeros(worlds, 2, len(COUNT_NAMES), dtype=torch.int32)
    for (name, agent), number in (counted or {}).items():
        agents["counts"][0, agent, COUNT_NAMES.index(name)] = number
    if in_force is not None:
        batch["next", "in_force"] = torch.tensor(in_force, dtype=torch.float32)
    return batch


def an_episode():
    """Three turns: agent 1 breaks a rule in the first two, is detected and fined in the second."""
    harvest = {"harvest": [[2, 2]]}
    seen = {("violations", 1): 2, ("foreign_bites", 1): 2, ("own_bites", 0): 2, ("detections", 1): 1}
    return (
        paying(violated=[[0, 1]], **harvest, in_force=[[0.25]], counted={("violations", 1): 1}),
        paying(violated=[[0, 1]], **harvest, fines=[[0, 1.5]], transfers=[[0.75, 0.75]], in_force=[[9]]),
        paying(fines=[[0.5, 0]], counted=seen, in_force=[[9]], done=[[True]]),
    )


def of_law(episode):
    return {name: value for name, value in episode.metrics.items() if name in OF_LAW}


def two_agents(*institutions):
    return Game(map=maps.parse(">A.<"), rules=Rules(), institutions=institutions)


def played(*turns, **options):
    tracker = EpisodeTracker(turns[0].batch_size[0], 2, **options)
    return [episode for batch in turns for episode in tracker.add(batch)]


def test_an_episode_has_what_was_paid_broken_counted_and_decided():
    (episode,) = played(*an_episode())
    assert episode.fines.tolist() == [0.5, 1.5]
    assert episode.transfers.tolist() == [0.75, 0.75]
    assert episode.violations.tolist() == [0, 2]
    assert list(episode.counts) == list(COUNT_NAMES)
    assert episode.counts["foreign_bites"].tolist() == [0, 2], "those of the last turn"
    assert episode.in_force.tolist() == [0.25], "that of the first turn"
    assert episode.reported == (*OPTIONAL_ENTRIES, *INSTITUTION_ENTRIES)
    assert left_out_note(episode.reported) == ""
    found = of_law(episode)
    assert set(OF_LAW) - set(found) == OF_GROUPS
    assert [found[f"institutions/{name}"] for name in ("fines", "transfers", "violations")] == [2.0, 1.5, 2.0]
    assert found["institutions/violations_per_step"] == 2 / 6, "three turns of two agents"
    shares = ("own_share_of_bites", "detection_rate", "recidivism")
    assert [found[f"institutions/{name}"] for name in shares] == [0.5, 0.5, 0.0]
    assert np.isnan(found["institutions/unjust_share_of_tags"])
    # net incomes 4 - 0.5 + 0.75 = 4.25 and 4 - 1.5 + 0.75 = 3.25: 1 - 2 / (2 * 2 * 7.5)
    assert found["income_equality"] == pytest.approx(1 - 2 / 30)
    assert episode.metrics["equality"] == 1.0, "of the harvest alone"


def test_a_table_has_the_counts_of_the_institutions_that_the_game_has_and_no_others():
    game = two_agents(Quota(share=0.5, window_steps=10, fine=1.0), Monitoring(prob=0.5))
    (episode,) = played(*an_episode(), game=game)
    table = table_of([episode])
    assert set(COUNT_NAMES) & set(table.column_names) == {"excess_bites", "violations", "detections"}
    of_counts = {name for name, metric in METRICS.items() if "counts" in metric.entries}
    curves = as_curves(table)
    known = {"institutions/excess_bites", "institutions/detection_rate"}
    assert set(curves) & of_counts == known == of_counts & set(episode.metrics)
    assert curves["institutions/detection_rate"] == [[0.5]]


def test_with_groups_inequality_within_and_between_them_is_measured():
    (episode,) = played(*an_episode(), game=two_agents(Levies(groups=((0,), (1,)))))
    assert episode.metrics["institutions/income_equality_within"] == 1.0
    assert episode.metrics["institutions/income_equality_between"] == pytest.approx(1 - 2 / 30)
    curves = as_curves(table_of([episode]))
    assert {"institutions/equality_between", "institutions/income_equality_within"} <= set(curves)
    assert curves["institutions/income_equality_between"].item() == pytest.approx(1 - 2 / 30)


def test_a_viewer_that_goes_on_with_a_run_has_the_measures_of_groups(tmp_path):
    (episode,) = played(*an_episode(), game=two_agents(Levies(groups=((0,), (1,)))))
    with EpisodeTable(tmp_path / "episodes.parquet") as table:
        table.add(episode)
    (again,) = stored_episodes(tmp_path)
    assert again.metrics["institutions/income_equality_between"] == pytest.approx(1 - 2 / 30)
    np.testing.assert_equal(again.metrics, episode.metrics)


def test_a_game_without_institutions_is_as_it_was():
    (episode,) = played(turn(done=[[True]]))
    assert (episode.fines, episode.counts, episode.in_force, of_law(episode)) == (None, None, None, {})
    assert not set(table_of([episode]).column_names) & set(COLUMNS)
    assert not [name for name in numbers_of(episode, {}, ["a", "b"]) if "institutions" in name]
    assert not any("institutions" in name for name in all_metrics(table_of([episode])))
    assert not {"fines", "counts"} & set(EpisodeTracker(1, 2).state_dict())


def test_each_world_pays_for_itself_and_starts_anew():
    first = paying(worlds=2, fines=[[1, 0], [0, 2]], done=[[True], [False]], in_force=[[1], [2]])
    second = paying(worlds=2, fines=[[0, 4], [0, 8]], done=[[True], [True]], in_force=[[3], [4]])
    episodes = played(first, second)
    assert [episode.fines.tolist() for episode in episodes] == [[1, 0], [0, 4], [0, 10]]
    assert [episode.in_force.tolist() for episode in episodes] == [[1], [3], [2]]


def test_a_tracker_goes_on_exactly_from_its_state(tmp_path):
    first, second, third = an_episode()
    tracker = EpisodeTracker(1, 2, game=two_agents(Levies(groups=((0,), (1,)))))
    tracker.add(first)
    torch.save(tracker.state_dict(), tmp_path / "tracker.pt")
    expected = all_written_out(tracker, [second, third, *an_episode()])
    for begun in (False, True):
        other = EpisodeTracker(1, 2, game=two_agents(Levies(groups=((0,), (1,)))))
        if begun:
            other.add(second)
        other.load_state_dict(torch.load(tmp_path / "tracker.pt"))
        assert all_written_out(other, [second, third, *an_episode()]) == expected


def test_a_batch_or_a_state_of_another_game_is_refused():
    tracker, without, two_votes = (EpisodeTracker(1, 2) for _ in range(3))
    tracker.add(paying(in_force=[[1]]))
    without.add(turn())
    two_votes.add(paying(in_force=[[1, 2]]))
    with pytest.raises(ValueError, match="the state is from a game that reports"):
        without.load_state_dict(tracker.state_dict())
    with pytest.raises(ValueError, match=r'"in_force" of the state is \[1, 1\]; allowed: \[1, 2\]'):
        two_votes.load_state_dict(tracker.state_dict())
    with pytest.raises(ValueError, match=r"the batch lacks \(next, in_force\)"):
        tracker.add(paying())
    lacks = paying(in_force=[[1]])
    del lacks["next", "agents", "fines"]
    with pytest.raises(ValueError, match=r"the batch lacks \(next, agents, fines\)"):
        tracker.add(lacks)
    wrong = paying()
    wrong["next", "agents", "counts"] = torch.zeros(1, 2, 3, dtype=torch.int32)
    with pytest.raises(ValueError, match='"counts" of the batch has 3 columns; allowed: 10'):
        EpisodeTracker(1, 2).add(wrong)


def test_a_game_that_pays_without_counting_has_the_metrics_of_payments():
    batch = an_episode()[2]
    del batch["next", "agents", "counts"]
    del batch["next", "agents", "violated"]
    (episode,) = played(batch)
    assert (episode.violations, episode.counts) == (None, None)
    assert list(of_law(episode)) == ["income_equality", "institutions/fines", "institutions/transfers"]
    assert [name for name in table_of([episode]).column_names if name in COLUMNS] == ["fines", "transfers"]


def test_the_table_has_a_column_for_each_number_and_keeps_it(tmp_path):
    (episode,) = played(*an_episode())
    with EpisodeTable(tmp_path / "episodes.parquet") as table:
        table.add(episode)
    kept = read_episodes(tmp_path)
    of_this = [name for name in COLUMNS if name != "decision"]  # nobody reported one
    expected = ["terminated", *of_this, "collective_return"]
    first = kept.column_names.index("terminated")
    assert kept.column_names[first : first + len(expected)] == expected
    numbers = {"fines": [0.5, 1.5], "violations": [0, 2], "own_bites": [2, 0]}
    numbers["institutions/in_force_0"] = [0.25, 0.25]
    assert kept.select(list(numbers)).to_pydict() == numbers
    found = {name: [value, value] for name, value in episode.metrics.items()}
    np.testing.assert_equal(kept.select(list(found)).to_pydict(), found)
    without = table_of(played(turn(done=[[True]])))
    assert set(kept.column_names) - set(expected) - set(found) <= set(without.column_names)


def test_curves_and_logged_numbers_are_those_of_the_episode():
    (episode,) = played(*an_episode())
    curves = as_curves(table_of([episode]))
    for name, value in episode.metrics.items():
        np.testing.assert_allclose(curves[name], [[value]], err_msg=name)
    assert curves["institutions/in_force_0"].tolist() == [[0.25]]
    assert not any("inst" in name for name in as_curves(table_of(played(turn(done=[[True]])))))
    numbers = numbers_of(episode, {}, ["ann", "bob"])
    assert numbers["institutions/detection_rate"] == 0.5
    assert numbers["institutions/in_force_0"] == 0.25
    assert (numbers["ann/fines"], numbers["bob/transfers"], numbers["bob/violations"]) == (0.5, 0.75, 2.0)


def test_undefined_numbers_are_counted_apart():
    first, second = (played(*an_episode())[0] for _ in range(2))
    first.metrics["institutions/detection_rate"] = NAN
    rows = table_of([first, second])
    found = estimates(rows, "institutions/detection_rate")["institutions/detection_rate"]
    assert str(found) == "0.50, undefined in 1 of 2 episodes"


MANY = (
    Boundaries.drawn("00.11\n00.11\n22.22", bite_fine=1.0, step_fine=0.125),
    Quota(share=2.0, window_steps=10, fine=0.5),
    ClosedSeason(period_steps=12, closed_steps=4, fine=0.25),
    Levies(groups=((0, 1), (2,)), local_rate=0.25, joint_rate=0.25),
    Vote(on=Tax(period_steps=5), choices=(0.0, 0.5)),
    Monitoring(prob=0.5, cost=0.125),
    GraduatedSanctions(freeze_steps=(1, 2), fines=(0.5, 1.0)),
    Mediation(turns=3, refund=2.0),
)
GAME = Game(
    map=maps.parse(">A.A.\n.AAA<\nA.^.A"),
    rules=Rules(regrow_prob=(0.05, 0.1), window_rows=3, window_columns=3, episode_steps=24),
    institutions=MANY,
    observation=Observation(agents_apart=True),
)


def play(game, *, worlds=3, episodes=2):
    """Episodes of random agents, and the batches."""
    env = CommonsEnv(game, worlds, seed=2)
    tracker = EpisodeTracker(worlds, game.agents, game=game)
    torch.manual_seed(1)
    found, batches, moment = [], [], env.reset()
    while len(found) < worlds * episodes:
        batch, moment = env.step_and_maybe_reset(env.rand_action(moment))
        batches.append(batch)
        found += tracker.add(batch)
    return found, batches


def test_what_a_game_pays_and_counts_is_what_an_episode_has():
    found, batches = play(GAME)
    names = ("fines", "transfers", "violated", "harvest", "counts", "reward")
    every = {name: torch.stack([batch["next", "agents", name] for batch in batches], 1) for name in names}
    for episode in found:
        turns = slice(24 * episode.episode, 24 * episode.episode + 24)
        own = {name: values[episode.world, turns] for name, values in every.items()}
        for name in ("fines", "transfers", "harvest"):
            assert getattr(episode, name).tolist() == own[name].double().sum(0).tolist()
        assert episode.violations.tolist() == own["violated"].sum(0).tolist()
        assert np.stack(list(episode.counts.values()), 1).tolist() == own["counts"][-1].tolist()
        assert episode.counts["violations"].tolist() == episode.violations.tolist()
        np.testing.assert_allclose(
            episode.return_, episode.harvest - episode.fines + episode.transfers, atol=1e-4
        )
        assert set(episode.in_force) <= {0.0, 0.5}
    total = {name: sum(own.counts[name].sum() for own in found) for name in COUNT_NAMES}
    assert all(total.values()), f"each happened: {total}"
    assert total["detections"] < total["violations"]


def test_a_game_with_all_institutions_has_all_metrics_and_others_those_that_concern_them():
    (episode, *_), _ = play(GAME, episodes=1)
    assert list(of_law(episode)) == OF_LAW
    always = {f"institutions/{name}" for name in ("fines", "transfers", "violations", "violations_per_step")}
    always |= {"income_equality"}
    kinds = {
        Boundaries: {"trespasses", "own_share_of_bites"},
        Quota: {"excess_bites"},
        ClosedSeason: {"closed_bites"},
        Levies: OF_GROUPS,
        Vote: set(),
        Monitoring: {"detection_rate"},
        GraduatedSanctions: {"recidivism", "sanctions_per_violation"},
        Mediation: {"unjust_share_of_tags"},
    }
    for institution in MANY:
        own = kinds[type(institution)]
        game = dataclasses.replace(GAME, institutions=(institution,))
        own = {name if name in OF_LAW else f"institutions/{name}" for name in own}
        assert set(metrics_for(EVERYTHING, game)) & set(OF_LAW) == always | own
    voting = dataclasses.replace(GAME, institutions=(Vote(on=Quota(), choices=(0.5, 1.0)),))
    assert "institutions/excess_bites" in metrics_for(EVERYTHING, voting)
    (taxed, *_), _ = play(dataclasses.replace(GAME, institutions=(Tax(rate=0.5),)), episodes=1)
    assert set(of_law(taxed)) == always
    assert taxed.fines.sum() == pytest.approx(taxed.harvest.sum() / 2)
    assert taxed.in_force is None
    assert {kind for kind in INSTITUTION_KINDS if not kind.counts} == {
        Tax,
        Levies,
        Vote,
        Governor,
        Sanctioner,
        Punishment,
    }


def test_trainings_and_evaluations_measure_what_concerns_the_game_behind_transforms():
    names = {"institutions/income_equality_within", "institutions/own_share_of_bites", "agent_2/fines"}
    undecided = tuple(own for own in MANY if not isinstance(own, Vote))
    game = dataclasses.replace(GAME, institutions=undecided)
    env = TransformedEnv(CommonsEnv(game, 2, seed=2), StepCounter())
    seen = []

    class Sees:
        def on_episode(self, episode, learning):
            seen.append(numbers_of(episode, learning, ["agent_0", "agent_1", "agent_2"]))

    agents = random_agents(game.spaces, (0, 1, 2), replicas=2, seed=1)
    train(env, {}, Schedule(episodes=1), others=agents, callbacks=[Sees()])
    assert names <= set(seen[0])
    first, *_ = evaluate(env, RandomPolicy(env.action_spec))
    assert "institutions/income_equality_between" in first.metrics
