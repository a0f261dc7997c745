"""EpisodeTracker: whole episodes out of batches of turns."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs.utils import RandomPolicy
from written_episodes import all_written_out, turn, written_out

from cprl import CommonsEnv, Game, Map, Rules
from cprl.measuring import EpisodeTracker, social
from cprl.measuring.registry import OPTIONAL_ENTRIES, metrics_for

GAME = Game(
    map=Map(height=2, width=4, sites=((0, 0), (0, 1), (1, 3)), starts=((1, 0, 1), (1, 1, 3), (0, 3, 3))),
    rules=Rules(regrow_prob=(0.0, 0.2), freeze_steps=2, beam_length_cells=2, episode_steps=9),
)


def collected(worlds, turns, *, seed=0):
    """Batches [B, turns] of random play, 60 turns in all."""
    env = CommonsEnv(GAME, worlds, seed=seed)
    torch.manual_seed(seed)
    collector = Collector(
        env,
        RandomPolicy(env.action_spec),
        frames_per_batch=worlds * turns,
        total_frames=worlds * 60,
        track_traj_ids=False,
        auto_register_policy_transforms=False,
    )
    batches = [batch.clone() for batch in collector]
    collector.shutdown()
    return batches


def test_an_episode_is_what_we_work_out_by_hand():
    tracker = EpisodeTracker(1, 2)
    # Agent 0 fires twice; the first beam crosses agent 1, which is tagged and misses one turn.
    first = turn(
        reward=[[[1.0], [0.5]]],
        harvest=[[1, 0]],
        fired=[[True, False]],
        hit_by=[[[False, False], [True, False]]],
        tagged_by=[[[False, False], [True, False]]],
    )
    second = turn(in_play=[[True, False]], fired=[[True, False]], stock=[[0]])
    third = turn(harvest=[[1, 1]], reward=[[[1.0], [1.0]]], stock=[[0]], done=[[True]], terminated=[[True]])
    assert tracker.add(first) == []
    assert tracker.add(second) == []
    (episode,) = tracker.add(third)
    values = written_out(episode)
    metrics = values.pop("metrics")
    assert values == {
        "world": "0",
        "replica": "0",
        "episode": "0",
        "steps": "3",
        "terminated": "True",
        "return_": [2.0, 1.5],
        "harvest": [2.0, 1.0],
        "in_play_steps": [3, 2],
        "shots": [2, 0],
        "hits": [1, 0],
        "tagged": [0, 1],
        "tagged_by": [[0, 0], [1, 0]],
        "stock_left": "0",
        "depletion_step": "2",
        **dict.fromkeys(("fines", "transfers", "violations", "counts", "decision", "in_force"), "None"),
        "wanted_return": "None",
    }
    # collective 3; equality 1 - 2 / (2 * 2 * 3); harvest at steps 1 and 3, and at 3; 5 agent-steps in play
    first_three = {"collective_return": 3.0, "efficiency": 1.0, "equality": 1 - 1 / 6}
    others = {
        "sustainability": 2.5,
        "survival_steps": 3.0,
        "peace": 5 / 3,
        "peacefulness": 2.5,
        "stock_left": 0.0,
    }
    assert metrics == repr(first_three | others)


def test_tagged_by_two_at_once_is_tagged_once_and_a_stock_that_never_ran_out_has_no_depletion_step():
    both = [[[False] * 3, [False] * 3, [True, True, False]]]
    (episode,) = EpisodeTracker(1, 3).add(turn(agents=3, hit_by=both, tagged_by=both, done=[[True]]))
    assert episode.tagged.tolist() == [0, 0, 1]
    assert episode.hits.tolist() == [1, 1, 0]
    assert episode.tagged_by.tolist() == [[0, 0, 0], [0, 0, 0], [1, 1, 0]]
    (episode,) = EpisodeTracker(1, 2).add(turn(done=[[True]], truncated=[[True]], stock=[[7]]))
    assert (episode.depletion_step, episode.stock_left, episode.terminated) == (-1, 7, False)


def test_each_world_counts_its_own_episodes_and_starts_anew():
    tracker = EpisodeTracker(2, 2)
    ended = []
    for done in ([[True], [False]], [[True], [True]], [[False], [True]]):
        ended += tracker.add(turn(worlds=2, harvest=[[1, 0], [0, 1]], done=done))
    harvests = [(e.world, e.episode, e.steps, e.harvest.tolist()) for e in ended]
    assert harvests == [(0, 0, 1, [1, 0]), (0, 1, 1, [1, 0]), (1, 0, 2, [0, 2]), (1, 1, 1, [0, 1])]
    (episode,) = tracker.add(turn(worlds=2, done=[[True], [True]], had_ended=[[False], [True]]))
    assert (episode.world, episode.episode, episode.steps) == (0, 2, 2), "world 1 ends no second time"
    (episode,) = tracker.add(turn(worlds=2, done=[[False], [True]], had_ended=[[True], [False]]))
    assert (episode.world, episode.episode, episode.steps) == (1, 2, 1)


def test_what_a_collector_yields_is_measured_as_the_whole_episodes_would_be():
    (batch,) = collected(worlds=3, turns=60)
    episodes = EpisodeTracker(3, 3).add(batch)
    assert len(episodes) >= 3 * 6
    assert any(episode.terminated for episode in episodes)
    first_step = dict.fromkeys(range(3), 0)
    for episode in episodes:
        world, first = episode.world, first_step[episode.world]
        first_step[world] = end = first + episode.steps
        root, following = batch[world, first:end], batch["next"][world, first:end]
        harvest, in_play = following["agents", "harvest"], root["agents", "in_play"]
        assert following["done"][-1].all()
        assert following["done"].sum() == 1
        assert np.array_equal(episode.harvest, harvest.sum(0))
        assert np.array_equal(episode.in_play_steps, in_play.sum(0))
        assert np.array_equal(episode.tagged, following["agents", "tagged_by"].any(-1).sum(0))
        metrics = {name: value.item() for name, value in social.summary(harvest, in_play).items()}
        metrics["stock_left"] = episode.stock_left
        assert episode.metrics == pytest.approx(metrics, nan_ok=True)


@pytest.mark.parametrize(
    "cut",
    [lambda whole: whole.unbind(1), *(partial(TensorDict.split, split_size=n, dim=1) for n in (1, 7, 20))],
)
def test_episodes_do_not_depend_on_how_the_turns_are_cut_into_batches(cut):
    (whole,) = collected(worlds=2, turns=60)
    expected = all_written_out(EpisodeTracker(2, 3), [whole])
    assert all_written_out(EpisodeTracker(2, 3), cut(whole)) == expected


def test_a_tracker_goes_on_exactly_from_its_state(tmp_path):
    first, second = collected(worlds=2, turns=30)
    tracker = EpisodeTracker(2, 3)
    tracker.add(first[:, :25])
    torch.save(tracker.state_dict(), tmp_path / "tracker.pt")
    expected = all_written_out(tracker, [first[:, 25:], second])
    other = EpisodeTracker(2, 3)
    other.add(second[:, :4])
    other.load_state_dict(torch.load(tmp_path / "tracker.pt"))
    assert all_written_out(other, [first[:, 25:], second]) == expected


def test_neither_a_state_nor_an_episode_changes_when_more_is_played():
    tracker = EpisodeTracker(1, 2)
    tracker.add(turn(harvest=[[1, 0]]))
    state = tracker.state_dict()
    (episode,) = tracker.add(turn(harvest=[[1, 0]], reward=[[[1.0], [0.0]]], done=[[True]]))
    before = written_out(episode)
    tracker.add(turn(harvest=[[1, 1]], reward=[[[1.0], [1.0]]], fired=[[True, True]]))
    assert (state["steps"].tolist(), state["harvest"].tolist()) == ([1], [[1, 0]])
    assert written_out(episode) == before


def test_a_yield_adds_its_share_to_the_metrics_and_what_does_not_fit_is_named():
    game = replace(GAME, rules=replace(GAME.rules, regrow_prob=(0.5, 0.5)))
    assert (game.sustainable_yield, game.tables.first_stock) == (1.0, 3)
    (episode,) = EpisodeTracker(1, 2, game=game).add(turn(harvest=[[2, 1]], done=[[True]]))
    assert episode.metrics["yield_share"] == 3 / (1 + 3)
    expected = [*metrics_for(OPTIONAL_ENTRIES)[:-1], "yield_share", "stock_left"]
    assert list(episode.metrics) == expected
    tracker = EpisodeTracker(2, 2)
    with pytest.raises(ValueError, match=r"the batch is \[1\]; allowed: \[2\] or \[2, T\]"):
        tracker.add(turn(worlds=1))
    with pytest.raises(ValueError, match=r'"reward" of the batch is \[2, 3, 1\]; allowed: \[2, 2, 1\]'):
        tracker.add(turn(worlds=2, agents=3))
    with pytest.raises(ValueError, match='"episode" of the state'):
        tracker.load_state_dict(EpisodeTracker(3, 2).state_dict())
