"""A seeded slice of `make fuzz`, in this process, and what `make fuzz` itself promises."""

import time
from dataclasses import replace

import pytest
from hypothesis import strategies as st

import cprl

from . import cases, public, register, runner, runs, table
from .cases import Case, Target
from .runner import ACCEPTED, REFUSED, Finding, Outcome

OF_EACH = 2
"""Cases of each target that the default tests run; `make fuzz` runs hundreds."""
SLICES = {
    "values": lambda own: own.weight > 1,
    "other constructors": lambda own: own.kind == cases.CONSTRUCTOR and own.weight == 1,
    "functions": lambda own: own.kind == cases.FUNCTION and own.weight == 1,
    "files": lambda own: own.kind == cases.FILE and own.weight == 1,
}


@pytest.fixture(scope="module", autouse=True)
def compiled():
    """Rules are compiled before the clock of a case runs: the first case of a clean clone would wait."""
    cprl.CommonsEnv(cprl.presets.game("single_basic"), 2, threads=1).rollout(2)
    runs.root()


@pytest.mark.integration
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # cases leave files open
@pytest.mark.parametrize("which", SLICES)
def test_generated_inputs_are_accepted_or_refused_as_documented(which, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(runner, "LONGEST_S", 60.0)  # scripted agents and pictures are compiled too
    found, answers = [], set()

    def each(number, case):
        how = runner.run_case(target, case, number)
        answers.add(how if isinstance(how, str) else "else")
        if isinstance(how, Finding):
            found.append(f"{target.name}({how.shown}): {how.what}")

    for target in filter(SLICES[which], register.targets().values()):
        runner.cases_of(target, OF_EACH, first_seed=16, each=each)
    assert found == []
    assert answers == {ACCEPTED, REFUSED}


def test_every_public_name_has_a_row():
    assert set(public.public_names()) <= set(register.targets())
    exported = public.public_names().values()
    assert {"Rules", "Experiment", "load", "train", "crossplay"} <= {own.__name__ for own in exported}


def test_exemptions_name_what_is_there():
    for name in public.NOT_CALLED:
        module, _, own = name.partition(":")
        assert public._at(f"{module}.{own}") is not None, name


ONE = st.just(Case({"value": 1}))


def a_target(call, *, refusals=(ValueError,), drawn=ONE, **how):
    return Target(name="own", kind=cases.FUNCTION, cases=drawn, call=call, refusals=refusals, **how)


def raises(error):
    def call(case):
        raise error

    return call


@pytest.mark.parametrize(
    ("error", "what"),
    [
        (KeyError("a"), "KeyError: 'a'"),
        (ValueError(""), "ValueError without a message"),
        (ValueError("a" * 3000), "ValueError with a message of 3000 characters"),
        (TypeError("no"), "TypeError: no"),
        (SystemExit(1), "SystemExit"),
        (RuntimeWarning("overflow encountered in add"), "RuntimeWarning: overflow encountered in add"),
    ],
)
def test_what_no_docs_promise_is_a_finding(error, what):
    how = runner.run_case(a_target(raises(error)), Case({}), 7)
    assert isinstance(how, Finding)
    assert how.case == 7
    assert how.what.startswith(what)


def test_documented_refusals_are_none():
    assert runner.run_case(a_target(raises(ValueError("a is 1; allowed: 2"))), Case({}), 0) == REFUSED
    missing = Case({}, misfits=True)
    assert runner.run_case(a_target(raises(TypeError("f() misses a"))), missing, 0) == REFUSED
    command = a_target(raises(SystemExit("cprl: there is no run")), is_command=True)
    assert runner.run_case(command, Case({}), 0) == REFUSED
    assert runner.run_case(a_target(raises(runs.Stopped())), Case({}), 0) == ACCEPTED


def test_a_case_that_hangs_is_ended_and_found(monkeypatch):
    monkeypatch.setattr(runner, "LONGEST_S", 0.05)
    how = runner.run_case(a_target(lambda case: time.sleep(60)), Case({}), 0)
    assert isinstance(how, Finding)
    assert how.what == "took longer than 0.05 s"


def test_what_is_accepted_is_looked_at():
    wrong = a_target(lambda case: 3, after=lambda case, result: f"it is {result}")
    how = runner.run_case(wrong, Case({}), 0)
    assert isinstance(how, Finding)
    assert how.what == "accepted, but it is 3"


def test_the_number_of_cases_is_exact_and_the_same_seed_draws_the_same_cases():
    few = a_target(lambda case: None, drawn=st.sampled_from((1, 2)).map(lambda own: Case({"a": own})))
    many = replace(few, cases=st.integers(0, 10**9).map(lambda own: Case({"a": own})))

    def drawn(target, seed):
        seen = []
        runner.cases_of(
            target, 30, first_seed=seed, each=lambda number, case: seen.append(case.arguments["a"])
        )
        return seen

    assert len(drawn(few, 0)) == 30, "of two that there are"
    assert drawn(many, 5) == drawn(many, 5) != drawn(many, 6)
    assert len(drawn(many, 5)) == 30


def test_the_table_has_a_row_for_each_target_and_one_for_all():
    outcome = Outcome()
    for how in (ACCEPTED, ACCEPTED, REFUSED, Finding(3, "KeyError", "")):
        outcome.add(0, how)
    text = table.markdown({"own": outcome}, {"own": a_target(print)}, command="make fuzz")
    assert "| `own` | 2 | 1 | 1 |" in text
    assert "| **all** | **2** | **1** | **1** |" in text
