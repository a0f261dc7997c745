"""Checks of paths, texts and live objects, each with a message that says what came and what is allowed."""

from pathlib import Path

import numpy as np
import pytest
import torch

import cprl
from cprl import CommonsEnv, Map, presets
from cprl.arguments import path, texts
from cprl.checks import plain
from cprl.measuring.evaluate import evaluate
from cprl.population import Scripted
from cprl.runs.episodes import read_episodes
from cprl.runs.export import export_results
from cprl.system.output import say
from cprl.training.collectors import StepCollector

COMMONS = presets.game("commons")


def test_texts_and_paths_are_paths():
    assert path("run", "runs/a") == path("run", Path("runs/a")) == Path("runs/a")


@pytest.mark.parametrize("given", [3, None, ("a",), "a\0b", Path("a\0b"), b"a"])
def test_anything_else_is_no_path(given):
    with pytest.raises(ValueError, match=r"^run is .*; allowed: a path, without NUL$"):
        path("run", given)


def test_a_single_text_is_no_list_of_texts():
    assert texts("allow", ["a:b", "c:d"]) == ("a:b", "c:d")
    for given in ("a:b", ["a", 3], 3, {"a": 1}):
        with pytest.raises(ValueError, match=r"^allow is .*; allowed: a tuple of entries, each a text"):
            texts("allow", given)
    with pytest.raises(ValueError, match="argv is "):
        texts("argv", [], 1)


@pytest.mark.parametrize("empty", [torch.zeros(3, device="meta"), torch.eye(3).to_sparse()])
def test_a_tensor_without_values_stays_as_it_is(empty):
    assert plain(empty) is empty


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: read_episodes(3), "run_directory is 3"),
        (lambda: export_results("a\0b", "x"), "run is "),
        (lambda: cprl.load(3), "run is 3"),
        (lambda: cprl.load("x", weights=[]), "weights is "),
        (lambda: cprl.run(3), "experiment is 3"),
        (lambda: StepCollector(3, print), "env is 3"),
        (lambda: evaluate(CommonsEnv(COMMONS), print, explore=torch.zeros(0)), "explore is "),
        (lambda: Map(height=1, width=9, sites=np.float32, starts=()), "Map.sites is "),
        (lambda: Map(height=np.float32, width=9, sites=(), starts=()), "Map.height is "),
    ],
)
def test_functions_refuse_what_is_of_another_kind_by_name(call, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        call()


def test_a_text_of_another_class_becomes_a_plain_one():
    class Text(str):
        pass

    assert type(Scripted(Text("random")).policy) is str


def test_what_is_nested_too_deeply_for_python_is_printed_all_the_same(capsys):
    nested = []
    nested.append(nested)
    for _ in range(10_000):
        nested = [nested]
    say(nested)
    assert capsys.readouterr().out == "[[[[[...]]]]]\n"
