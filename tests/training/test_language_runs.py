"""Runs of language agents: stored, killed, resumed, replayed without a network; equal bit for bit."""

import json
import os
import signal
import subprocess
import sys
import threading
from dataclasses import replace

import pytest
from language_runs import TALK, experiment, language, offline, run_language
from model_server import plan, served
from places import ROOT
from same_runs import assert_same_training
from small_learners import ALGORITHMS

import cprl
from cprl import Fresh
from cprl.evaluation.film import Style, film_episode
from cprl.policies.asking import CALLS, read_calls
from cprl.population import Frozen, Learning, Scripted, learned
from cprl.runs.export import export_results
from cprl.web.report import report
from cprl.web.show import show


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


SCRIPT = "<script>alert(1)</script>"


def talker(request):
    """Answer a plan and a message that depend on what the agent has read, and on its seed."""
    read = request["messages"][1]["content"].count("says")
    return json.dumps({**json.loads(plan(request)), "message": f"{SCRIPT} {read} {request['seed']}"})


@pytest.mark.integration
def test_messages_are_what_they_were_after_a_stop_and_without_a_network_and_no_page_runs_them(tmp_path):
    with served(talker) as server:
        mute = replace(language(server.url, model=SCRIPT), instructions="You never listen.")
        agents = (replace(mute, instructions="", every_steps=7),) * 3 + (mute,)
        fields = {"game": TALK, "agents": agents, "episodes": 2, "replicas": 1}
        quiet = {"watch": "off"}
        run = cprl.run(experiment(None, **fields), tmp_path / "run", **quiet)
        prompts = [request["messages"][1]["content"] for request in server.requests]
        assert any(f'Agent 3 says: "{SCRIPT} ' in prompt for prompt in prompts)
        asked = len(prompts)

        class Stops:
            def on_step(self, batch):
                if len(server.requests) - asked > 9:
                    signal.raise_signal(signal.SIGINT)

        with pytest.raises(KeyboardInterrupt):
            cprl.run(experiment(None, **fields), tmp_path / "stopped", callbacks=[Stops()], **quiet)
        assert asked + 9 < len(server.requests) < 2 * asked
        cprl.run(experiment(None, **fields), tmp_path / "stopped", resume=True, **quiet)
        assert len(server.requests) == 2 * asked
        pages = [show(run, tmp_path / "show.html")[0], report(run, tmp_path / "report.html", episodes=1)]
    calls = read_calls(run / CALLS)
    assert_same_training(run, tmp_path / "stopped")
    agents = tuple(offline(run, spec) for spec in agents)
    cprl.run(experiment(None, **{**fields, "agents": agents}), tmp_path / "again", **quiet)
    assert_same_training(run, tmp_path / "again")
    assert {*read_calls(tmp_path / "again" / CALLS)} <= {*calls}
    for page in pages:
        assert SCRIPT not in page.read_text(encoding="utf-8")


@pytest.mark.integration
def test_language_agents_are_filmed_and_shown_and_play_in_cross_play(tmp_path):
    with served() as server:
        fields = {"episodes": 1, "replicas": 1}
        runs = [tmp_path / name for name in ("planners", "greedy")]
        cprl.run(experiment(language(server.url), **fields), runs[0], watch="off")
        scripts = experiment(None, agents=(Scripted("greedy"),) * 4, **fields)
        cprl.run(scripts, runs[1], watch="off")
        asked = len(server.requests)
        _, (filmed,) = film_episode(runs[0], tmp_path / "film.gif", style=Style(width=240, fps=10))
        assert len(server.requests) > asked
        asked = len(server.requests)
        _, (shown,) = show(runs[0], tmp_path / "show.html")
        assert len(server.requests) == asked, "it shows the episode of the film"
        assert shown.harvest.tolist() == filmed.harvest.tolist()
        table = cprl.crossplay(runs, Fresh(episodes=1, seed=9))
        assert len(server.requests) > asked
        asked = len(server.requests)
        assert cprl.crossplay(runs, Fresh(episodes=1, seed=9)).equals(table)
        assert len(server.requests) == asked


@pytest.mark.integration
def test_progress_and_summary_count_calls_and_tokens_and_show_no_prompt_key_or_answer(
    tmp_path, capsys, monkeypatch
):
    monkeypatch.setenv("A_KEY", "sesame")
    with served(lambda request: "no plan" if request["seed"] % 2 else plan(request)) as server:
        spec = language(server.url, key_variable="A_KEY", prices=(100, 1000))
        run = run_language(spec, tmp_path / "run")
    output = "".join(capsys.readouterr())
    calls = read_calls(run / CALLS).values()
    bad = sum(call["failure"] is not None for call in calls)
    tokens = f"{100 * len(calls):,} + {20 * len(calls):,} tokens"
    assert f"{len(calls)} calls, {tokens}, {bad} without a usable answer" in output
    assert f"a usable answer, {0.03 * len(calls):,.4f} US dollars (10,000 such calls: 300.00)" in output
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
        cprl.run(mixed, tmp_path / "mixed", watch="off")


@pytest.mark.integration
def test_calls_of_a_frozen_language_agent_are_kept_in_the_run_in_which_it_is_frozen(tmp_path):
    quiet = {"watch": "off", "figures": False}
    fields = {"episodes": 1, "replicas": 1, "evaluation_episodes": 1}
    with served() as server:
        first = cprl.run(experiment(language(server.url), **fields), tmp_path / "first", **quiet)
        kept = read_calls(first / CALLS)
        frozen = [Frozen(os.path.relpath(first), agent) for agent in range(3)]
        mixed = experiment(None, agents=(*frozen, Scripted("greedy")), **fields)
        second = cprl.run(mixed, tmp_path / "second", **quiet)
        cprl.evaluate_run(second, Fresh(episodes=1, seed=9))
    assert read_calls(first / CALLS) == kept
    assert any("seed 9" in call["call"] for call in read_calls(second / CALLS).values())


def test_learning_agents_learn_beside_language_agents(tmp_path):
    with served() as server:
        agents = (Learning(ALGORITHMS["DQN"]), *(language(server.url),) * 2, Scripted("greedy"))
        run = cprl.run(experiment(None, agents=agents, episodes=2), tmp_path / "run", watch="off")
        assert len(server.requests) >= 2 * 2 * (2 + 2)
    assert len(cprl.load(run).networks) == 2
