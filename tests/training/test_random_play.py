"""Random play before a training: what it is compared with while it runs, and what does not change by it."""

import random
from dataclasses import replace

import numpy as np
import pytest
import torch
from recordings import column
from rerun.chunk import RrdReader
from torchrl.envs import Transform
from watched import EXPERIMENT

import cprl
from cprl.envs.env_state import load_transforms_state, transforms_state
from cprl.institutions import Tax, Vote
from cprl.measuring.playing import evaluate
from cprl.measuring.statistics import estimate
from cprl.measuring.windows import last_of
from cprl.population import Scripted
from cprl.runs.curves import as_curves
from cprl.runs.episodes import read_episodes, read_table
from cprl.system.defaults import LAST_EPISODES
from cprl.training.evaluating import evaluate_population, fresh_env, is_repeatable, make_agents, random_play
from cprl.values import Custom


def numbers(episodes):
    return [
        (episode.world, episode.steps, episode.return_.tolist(), episode.harvest.tolist(), episode.stock_left)
        for episode in episodes
    ]


def test_random_play_before_is_the_one_after_and_the_trained_agents_meet_the_same_worlds():
    env, population = make_agents(EXPERIMENT)
    before = random_play(EXPERIMENT, population)
    as_ever = evaluate_population(EXPERIMENT, *make_agents(EXPERIMENT))
    reused = evaluate_population(EXPERIMENT, env, population, random=before)
    assert len(before) == 8
    assert reused["random"] is before
    assert numbers(before) == numbers(as_ever["random"])
    assert numbers(reused["trained"]) == numbers(as_ever["trained"])


def test_random_play_moves_no_generator_even_of_a_game_that_draws_from_global_ones(monkeypatch):
    _, population = make_agents(EXPERIMENT)

    def states():
        of_numpy = np.random.get_state()  # noqa: NPY002  (the global generator is the point)
        return repr((torch.get_rng_state().tolist(), random.getstate(), of_numpy))

    def drawing(experiment):
        env = fresh_env(experiment)
        torch.rand(1), random.random(), np.random.rand()  # noqa: NPY002
        return env

    monkeypatch.setattr("cprl.training.evaluating.fresh_env", drawing)
    before = states()
    random_play(EXPERIMENT, population)
    assert states() == before


def test_random_play_of_a_game_with_transforms_or_ballots_or_of_somebody_elses_is_played_again():
    assert is_repeatable(EXPERIMENT)
    counter = Custom("torchrl.envs:StepCounter", {})
    assert not is_repeatable(replace(EXPERIMENT, transforms=(counter,)))
    voting = replace(EXPERIMENT.game, institutions=(Vote(on=Tax()),))
    assert not is_repeatable(replace(EXPERIMENT, game=voting)), "agents see what random ones voted for"
    somebodys = replace(EXPERIMENT, game=Custom("matrix_game:MatrixGame"), agents=(Scripted("random"),) * 2)
    assert not is_repeatable(somebodys)


@pytest.mark.integration
def test_a_run_has_the_same_outcome_watched_or_not_and_its_recording_shows_the_end(tmp_path):
    off, watched = (cprl.run(EXPERIMENT, tmp_path / watch, watch=watch) for watch in ("off", "file"))
    for policy in ("random", "trained"):
        unwatched, others = (read_table(run / "evaluation" / f"{policy}.parquet") for run in (off, watched))
        assert unwatched.equals(others)
    headers = [text[0] for text in column(watched / "run.rrd", "header", "TextDocument:text")[1]]
    harvests = (
        np.array(read_table(watched / "evaluation" / f"{policy}.parquet")["collective_return"])
        for policy in ("random", "trained")
    )
    means = [harvest.reshape(EXPERIMENT.replicas, -1).mean(1) for harvest in harvests]
    estimates = [estimate(of_replicas).bounded("collective_return") for of_replicas in means]
    random, trained = (each.value for each in estimates)
    assert headers[0].startswith("#### Episode 1 of 3 · begins")
    assert headers[-2].startswith("#### Episode 3 of 3 · begins, exploring · ")
    assert f" apples, random play {random:.3g} · " in headers[-2]
    learning = as_curves(last_of(read_episodes(watched), LAST_EPISODES))["collective_return"].mean()
    ended = f"#### Finished, 3 episodes · while learning {learning:.3g} apples, trained {trained:.3g}, "
    assert headers[-1].startswith(f"{ended}random play {random:.3g} · ")
    events = [text[0] for text in column(watched / "run.rrd", "log", "TextLog:text")[1]]
    assert any(event.startswith(f"random play {estimates[0]} apples") for event in events)
    assert any(event.startswith(f"finished: trained {estimates[1]} apples") for event in events)
    assert not any("checkpoint" in event for event in events)
    lines = column(watched / "run.rrd", "random_play/survival_steps", "Scalars:scalars", "episode")
    assert lines[0] == [0, 1, 2]
    RrdReader(watched / "run.rrd").store()  # which a file without its footer refuses


class Counting(Transform):
    """Counts the observations that it has seen, as statistics of a normalisation would."""

    def __init__(self):
        super().__init__()
        self.register_buffer("seen", torch.zeros(()))

    def _call(self, next_tensordict):
        self.seen += 1
        return next_tensordict

    def _reset(self, tensordict, tensordict_reset):
        return self._call(tensordict_reset)


def test_what_transforms_have_learned_is_the_same_for_everybody_who_is_evaluated(monkeypatch):
    experiment = replace(EXPERIMENT, transforms=(Custom("test_random_play:Counting"),))
    env, population = make_agents(experiment)
    load_transforms_state(env, {"transforms.0.seen": torch.tensor(100.0)})
    begun = []

    def noting(env, policy, **options):
        begun.append(transforms_state(env)["transforms.0.seen"].item())
        return evaluate(env, policy, **options)

    monkeypatch.setattr("cprl.training.evaluating.evaluate", noting)
    evaluate_population(experiment, env, population)
    assert begun == [100, 100], "random play does not count"
