"""Runs of language agents: stored, killed, resumed, replayed without a network; equal bit for bit."""

import os
import signal
import subprocess
import sys
import threading

import pytest
from language_runs import experiment, language, offline, run_language
from model_server import plan, served
from places import ROOT
from same_runs import assert_same_training
from small_learners import ALGORITHMS

import cprl
from cprl import Fresh
from cprl.policies.asking import CALLS, read_calls
from cprl.population import Frozen, Learning, Scripted, learned
from cprl.runs.export import export_results


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run that nobody stopped, and its specification."""
    with served() as server:
        spec = language(server.url)
        run = run_language(spec, tmp_path_factory.mktemp("language") / "run")
        assert len(server.requests) == len(read_calls(run / CALLS)) > 100
    return run, spec


def test_a_run_replays_without_a_network_bit_for_bit(finished, tmp_path):
    run, spec = finished
    again = run_language(offline(run, spec), tmp_path / "again")
    assert_same_training(run, again)
    assert read_calls(run / CALLS) == read_calls(again / CALLS)
    assert cprl.load(again).specs[0].stored == os.path.relpath(run), "from where one works, not from the run"
    played, replayed = (cprl.load(one).episodes() for one in (run, again))
    assert played.equals(replayed)


def test_a_changed_prompt_is_refused_by_the_name_of_its_call(finished, tmp_path):
    run, spec = finished
    changed = cprl.population.Language(**{**vars(offline(run, spec)), "instructions": "Be kind."})
    with pytest.raises(
        ValueError, match=r"calls.jsonl keeps no answer for exploration, seed 3.*another messages"
    ):
        run_language(changed, tmp_path / "changed")


@pytest.mark.integration
def test_a_run_that_is_stopped_resumes_and_asks_nothing_twice(finished, tmp_path):
    run, _ = finished
    calls = len(read_calls(run / CALLS))
    with served() as server:
        spec = language(server.url)

        class Stops:
            def on_step(self, batch):
                if len(server.requests) > 70:
                    signal.raise_signal(signal.SIGINT)

        with pytest.raises(KeyboardInterrupt):
            run_language(spec, tmp_path / "run", callbacks=[Stops()])
        run_language(spec, tmp_path / "run", resume=True)
        asked = [(request["seed"], str(request["messages"])) for request in server.requests]
        assert len(asked) == len(set(asked)) == calls
    assert_same_training(run, tmp_path / "run")


@pytest.mark.integration
def test_a_run_that_is_killed_resumes_and_asks_nothing_twice(finished, tmp_path):
    run, _ = finished
    calls = len(read_calls(run / CALLS))
    killed = threading.Event()
    with served() as server:

        def answer(request):
            if len(server.requests) == 60 and not killed.is_set():
                killed.set()
                os.kill(process.pid, signal.SIGKILL)
            return plan(request)

        server.answer = answer
        words = [
            sys.executable,
            str(ROOT / "tests/support/language_runs.py"),
            server.url,
            str(tmp_path / "run"),
        ]
        process = subprocess.Popen(words)
        assert process.wait(300) == -signal.SIGKILL
        kept = len(read_calls(tmp_path / "run" / CALLS))
        assert 0 < kept < 60
        asked = len(server.requests)
        run_language(language(server.url), tmp_path / "run", resume=True)
        assert len(server.requests) == asked + calls - kept, "what was answered to nobody is asked again"
    assert_same_training(run, tmp_path / "run")


@pytest.mark.integration
def test_progress_and_summary_count_calls_and_tokens_and_show_no_prompt_key_or_answer(
    tmp_path, capsys, monkeypatch
):
    monkeypatch.setenv("A_KEY", "sesame")
    with served(lambda request: "no plan" if request["seed"] % 2 else plan(request)) as server:
        run = run_language(language(server.url, key_variable="A_KEY"), tmp_path / "run")
    output = "".join(capsys.readouterr())
    calls = read_calls(run / CALLS).values()
    bad = sum(call["failure"] is not None for call in calls)
    tokens = f"{100 * len(calls):,} + {20 * len(calls):,} tokens"
    assert f"{len(calls)} calls, {tokens}, {bad} without a usable answer" in output
    for secret in ("sesame", "no plan", "You are one of", "point for you"):
        assert secret not in output
    everything = b"".join(path.read_bytes() for path in run.rglob("*") if path.is_file())
    assert b"sesame" not in everything


def test_a_stored_run_is_evaluated_exported_frozen_and_described(finished, tmp_path):
    run, spec = finished
    copy = export_results(run, tmp_path / "copy")
    assert read_calls(copy / CALLS) == read_calls(run / CALLS)
    assert learned(cprl.load(run).specs) == "4 agents by the language model small"
    kept = len(read_calls(copy / CALLS))
    cprl.evaluate_run(copy, Fresh(episodes=1, seed=9, replicas=(0,)))
    fresh = [call for call in read_calls(copy / CALLS).values() if "seed 9" in call["call"]]
    assert len(fresh) == len(read_calls(copy / CALLS)) - kept >= 4
    assert {call["failure"].split(":")[0] for call in fresh} == {"no connection"}, "its server is gone"
    frozen = [Frozen(os.path.relpath(copy), agent, 0) for agent in range(3)]
    mixed = experiment(spec, agents=(*frozen, Scripted("greedy")), episodes=1, replicas=1)
    with pytest.raises(ConnectionError, match=spec.base_url):
        cprl.run(mixed, tmp_path / "mixed", watch="off", figures=False)


def test_learning_agents_learn_beside_language_agents(tmp_path):
    with served() as server:
        agents = (Learning(ALGORITHMS["DQN"]), *(language(server.url),) * 2, Scripted("greedy"))
        run = cprl.run(
            experiment(None, agents=agents, episodes=2), tmp_path / "run", watch="off", figures=False
        )
        assert len(server.requests) >= 2 * 2 * (2 + 2)
    assert len(cprl.load(run).networks) == 2
