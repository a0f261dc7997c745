"""Checks of paths, texts and live objects, each with a message that says what came and what is allowed."""

from pathlib import Path

import pytest
import torch

from cprl import presets
from cprl.arguments import path, texts
from cprl.checks import plain
from cprl.population import Scripted
from cprl.system.output import say

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
