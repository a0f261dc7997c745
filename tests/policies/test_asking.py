"""Calls to a language model are made once, kept, limited, tried again, and never break what asks."""

import json
import os
import socket

import pytest
from model_server import HALF, LONG, ODD, SILENT, SLOW, served

from cprl.policies.asking import CALLS, OVER_LIMIT, Calls, Model, Question, read_calls

QUICK = {"model": "small", "timeout_s": 5.0, "retries": 0, "backoff_s": 0.0}


def question(number, prompt="go"):
    return Question(f"call {number}", number, "rules", prompt)


def number_in(table):
    if not isinstance(table.get("n"), int):
        raise ValueError("n is missing")
    return table["n"]


def by_seed(request):
    return f'I think {{"n": {request["seed"]}}} is best.'


def test_several_questions_are_answered_in_their_order_and_asked_once(tmp_path):
    with served(by_seed) as server:
        model = Model(base_url=server.url, **QUICK)
        calls = Calls()
        calls.keep_in(tmp_path / CALLS)
        assert calls.ask(model, [question(number) for number in (3, 1, 2)], number_in) == [3, 1, 2]
        assert calls.ask(model, [question(1), question(4)], number_in) == [1, 4]
        assert len(server.requests) == 4
        again = Calls()
        again.keep_in(tmp_path / CALLS)
        assert again.ask(model, [question(number) for number in (1, 2, 3, 4)], number_in) == [1, 2, 3, 4]
        assert len(server.requests) == 4
    kept = [json.loads(line) for line in (tmp_path / CALLS).read_text().splitlines()]
    assert {call["call"] for call in kept} == {f"call {number}" for number in (1, 2, 3, 4)}
    assert all(call["request"]["messages"][1]["content"] == "go" for call in kept)
    assert {(call["prompt_tokens"], call["answer_tokens"], call["tries"]) for call in kept} == {(100, 20, 1)}
    assert all(call["failure"] is None and call["seconds"] >= 0 for call in kept)
    assert again.in_words() == "4 calls, 400 + 80 tokens, 0 without a usable answer"
    assert Calls().in_words() == ""


@pytest.mark.parametrize(
    ("answer", "failure"),
    [
        ("I would rather not.", "no JSON"),
        ('{"n": 3', "no JSON"),
        ("[" * 5000, "no JSON"),
        ('{"n": ' * 5000, "no JSON"),
        ('{"m": 3}', "n is missing"),
        ("", "no JSON"),
        (SILENT, "an answer without text"),
        (ODD, "a broken answer: KeyError"),
        (HALF, "a broken answer"),
        (LONG, "a broken answer: ValueError"),
        (SLOW, "no answer in time"),
        (429, "status 429"),
        (500, "status 500"),
    ],
)
def test_a_bad_answer_is_kept_and_counted_and_is_none(answer, failure, tmp_path):
    with served(lambda request: answer if request["seed"] else by_seed(request)) as server:
        model = Model(base_url=server.url, **{**QUICK, "timeout_s": 0.3})
        calls = Calls()
        calls.keep_in(tmp_path / CALLS)
        assert calls.ask(model, [question(1), question(0)], number_in) == [None, 0]
        (bad,) = [call for call in read_calls(tmp_path / CALLS).values() if call["call"] == "call 1"]
        assert failure in bad["failure"]
        assert "1 without a usable answer" in calls.in_words()
        asked = len(server.requests)
        assert calls.ask(model, [question(1)], number_in) == [None], "nor is it asked again"
        assert len(server.requests) == asked


def test_a_busy_server_is_asked_again_and_a_server_that_refuses_is_not():
    answers = {1: [429, 500, '{"n": 1}'], 2: [400], 0: ['{"n": 0}']}
    with served(lambda request: answers[request["seed"]].pop(0)) as server:
        model = Model(base_url=server.url, **{**QUICK, "retries": 2, "backoff_s": 0.01})
        calls = Calls()
        assert calls.ask(model, [question(0)], number_in) == [0]
        assert calls.ask(model, [question(1), question(2)], number_in) == [1, None]
        assert sorted(call["tries"] for call in calls.kept.values()) == [1, 1, 3]


def test_calls_beyond_the_most_are_not_made_and_run_beside_each_other_as_allowed():
    with served(by_seed) as server:
        model = Model(base_url=server.url, **QUICK, max_calls=3, concurrency=2)
        calls = Calls()
        assert calls.ask(model, [question(number) for number in range(5)], number_in) == [0, 1, 2, None, None]
        assert calls.ask(model, [question(9)], number_in) == [None]
        assert len(server.requests) == 3
        assert server.most_at_once <= 2
        assert [call["failure"] for call in calls.kept.values()].count(OVER_LIMIT) == 3


def test_a_server_that_is_not_there_or_refuses_all_is_named_before_anything_is_kept(tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{free.getsockname()[1]}/v1"
    calls = Calls()
    calls.keep_in(tmp_path / CALLS)
    with pytest.raises(ConnectionError, match=f"{url} with the model 'small': no connection"):
        calls.ask(Model(base_url=url, **QUICK), [question(0)], number_in)
    with served(lambda request: 401) as server, pytest.raises(ConnectionError, match="status 401"):
        calls.ask(Model(base_url=server.url, **QUICK), [question(0)], number_in)
    assert not (tmp_path / CALLS).exists()


def test_a_server_that_goes_away_is_no_crash_for_calls_at_the_same_time():
    calls = Calls()
    with served(by_seed) as server:
        model = Model(base_url=server.url, **QUICK, concurrency=16)
        assert calls.ask(model, [question(0)], number_in) == [0]
    answers = calls.ask(model, [question(number) for number in range(200)], number_in)
    assert answers == [0] + [None] * 199


def test_the_key_is_sent_and_never_kept(tmp_path, monkeypatch):
    monkeypatch.setenv("A_KEY", "sesame")
    with served(by_seed) as server:
        calls = Calls()
        calls.keep_in(tmp_path / CALLS)
        model = Model(base_url=server.url, **QUICK, key_variable="A_KEY")
        calls.ask(model, [question(0)], number_in)
        assert server.headers[0]["Authorization"] == "Bearer sesame"
        calls.ask(Model(base_url=server.url, **QUICK), [question(1)], number_in)
        assert "Authorization" not in server.headers[1]
    assert "sesame" not in (tmp_path / CALLS).read_text() + repr(model)


def test_what_calls_cost_is_kept_and_said_where_prices_are(tmp_path):
    with served(by_seed) as server:
        calls = Calls()
        calls.keep_in(tmp_path / CALLS)
        model = Model(base_url=server.url, **QUICK, prices=(0.5, 20), max_calls=1000)
        calls.ask(model, [question(0), question(1)], number_in)
        # 100 tokens of a prompt and 20 of an answer: 0.00005 + 0.0004 dollars
        assert [call["dollars"] for call in read_calls(tmp_path / CALLS).values()] == [0.00045] * 2
        words = "0 without a usable answer, 0.0009 US dollars (1,000 such calls: 0.45)"
        assert calls.in_words() == f"2 calls, 200 + 40 tokens, {words}"
        resumed = Calls()
        resumed.keep_in(tmp_path / CALLS)
        assert resumed.in_words().endswith("0.0009 US dollars")
    with pytest.raises(ValueError, match=r"Model\.prices"):
        Model(model="small", prices=(-1, 2))


def test_a_stored_run_answers_without_a_network_and_a_changed_prompt_is_refused_by_name(tmp_path):
    first, second = tmp_path / "first", tmp_path / "second"
    first.mkdir()
    second.mkdir()
    with served(by_seed) as server:
        calls = Calls()
        calls.keep_in(first / CALLS)
        model = Model(base_url=server.url, **QUICK)
        calls.ask(model, [question(0), question(1)], number_in)
    offline = Model(**QUICK, stored=os.path.relpath(first))
    again = Calls()
    again.keep_in(second / CALLS)
    assert again.ask(offline, [question(0), question(1)], number_in) == [0, 1]
    assert read_calls(first / CALLS) == read_calls(second / CALLS)
    for changed, words in (
        (question(1, "stop"), "call 1: it keeps one with another messages"),
        (question(1)._replace(seed=7), "call 1: it keeps one with another seed"),
        (question(2), "call 2: it keeps none of that name"),
    ):
        with pytest.raises(ValueError, match=words):
            again.ask(offline, [changed], number_in)


def test_a_line_that_was_cut_by_a_kill_is_asked_again_and_the_next_is_whole(tmp_path):
    path = tmp_path / CALLS
    with served(by_seed) as server:
        model = Model(base_url=server.url, **QUICK, concurrency=1)
        calls = Calls()
        calls.keep_in(path)
        calls.ask(model, [question(0), question(1)], number_in)
        path.write_bytes(path.read_bytes()[:-20])
        calls = Calls()
        calls.keep_in(path)
        assert calls.ask(model, [question(0), question(1), question(2)], number_in) == [0, 1, 2]
        assert [request["seed"] for request in server.requests] == [0, 1, 1, 2]
    assert len(read_calls(path)) == 3


def test_a_file_that_holds_something_else_is_refused(tmp_path):
    (tmp_path / CALLS).write_text('{"hash": "0"}\n')
    with pytest.raises(ValueError, match=r"calls.jsonl holds .*allowed: calls"):
        Calls().keep_in(tmp_path / CALLS)


@pytest.mark.parametrize(
    ("field", "value"),
    [("base_url", "file:///etc"), ("max_calls", 0), ("timeout_s", 0), ("retries", -1), ("stored", "/a/run")],
)
def test_a_model_that_cannot_be_asked_is_refused(field, value):
    with pytest.raises(ValueError, match=rf"Model\.{field}"):
        Model(**{"model": "small", field: value})
