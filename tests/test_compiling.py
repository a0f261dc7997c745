"""Compiled: the same as the plain function, whatever form its arguments take."""

import warnings

import pytest
import torch
from tensordict import TensorDict

from cprl.system import compiling
from cprl.system.compiling import Compiled, largest_difference


def scaled_in_place(owner, values, factor):
    values.mul_(factor)
    return values.sum() + owner.offset


class Owner:
    offset = 1.0


@pytest.mark.integration
def test_what_is_compiled_is_called_directly_and_compiled_again_for_another_form():
    step = Compiled(scaled_in_place, what="steps run", changes=(1,))
    for size in (3, 5):
        values, factor = torch.ones(size), torch.tensor(2.0)
        for times in (1, 2, 3):
            total = step((size,), Owner, values, factor)
            assert values.tolist() == [2.0**times] * size
            assert total == size * 2.0**times + 1
        assert step.enabled
        assert not hasattr(step._compiled, "_torchdynamo_orig_callable"), "torch's own wrapper is gone"
    torch._dynamo.reset()  # as someone else in the process may
    assert step((5,), Owner, values, factor) == 5 * 2.0**4 + 1


@pytest.mark.integration
def test_two_of_one_function_do_not_disturb_each_other():
    small, large = (Compiled(scaled_in_place, what="steps run", changes=(1,)) for _ in range(2))
    factor = torch.tensor(3.0)
    for _ in range(2):
        assert small((), Owner, torch.ones(2), factor) == 7
        assert large((), Owner, torch.ones(4), factor) == 13


def through_a_module(owner, values, keeps):
    """What a module gives with weights that were computed, as a lane's are."""
    with TensorDict({"weight": values.clone()}).to_module(owner, preserve_module_state=keeps):
        return owner.weight.detach() * 1


class Holder(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.ones(3))


@pytest.mark.integration
def test_weights_put_into_a_module_as_tensordict_does_by_default_do_not_compile_and_the_cure_is_said():
    by_default, cured = (Compiled(through_a_module, what="steps run") for _ in range(2))
    with pytest.warns(RuntimeWarning, match="preserve_module_state=False"):
        assert by_default((True,), Holder(), torch.full((3,), 2.0), True).tolist() == [2.0] * 3
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        assert cured((False,), Holder(), torch.full((3,), 2.0), False).tolist() == [2.0] * 3
    assert (by_default.enabled, cured.enabled) == (False, True)


@pytest.fixture
def compiles_as(monkeypatch):
    """Puts a function in place of what torch.compile would give."""
    return lambda function: monkeypatch.setattr(compiling.torch, "compile", lambda *_, **__: function)


def test_a_compiled_function_that_gives_other_numbers_is_found_out(compiles_as):
    values = [torch.ones(3), torch.ones(2)]
    step = Compiled(scaled_both, what="steps run", changes=(1,))
    compiles_as(lambda owner, both, factor: [one.mul_(2.5) for one in both] and both[0].sum())
    with pytest.warns(RuntimeWarning, match=r"differ by up to 1\.5 from uncompiled code, steps run unc"):
        first = step((), Owner, values, torch.tensor(2.0))
    assert first == 6
    assert [one.tolist() for one in values] == [[2.0] * 3, [2.0] * 2]
    assert step((), Owner, values, torch.tensor(2.0)) == 12
    assert [one.tolist() for one in values] == [[4.0] * 3, [4.0] * 2]
    assert not step.enabled


def scaled_both(owner, both, factor):
    for one in both:
        one.mul_(factor)
    return both[0].sum()


def test_a_wrong_result_is_found_out_though_nothing_else_is_changed(compiles_as):
    compiles_as(lambda values: values * 1.01)
    double = Compiled(lambda values: values * 1.0, what="steps run")
    with pytest.warns(RuntimeWarning, match="differ by up to 0.03"):
        assert double((), torch.arange(4.0)).tolist() == [0, 1, 2, 3]


def test_comparing_draws_no_random_numbers_and_a_function_that_does_is_not_compared(compiles_as):
    def noisy(values):
        return values + torch.rand(3)

    compiles_as(lambda values: values + torch.rand(3) ** 2)  # as a compiler may, by numbers of its own
    step = Compiled(noisy, what="steps run")
    torch.manual_seed(5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        came = step((), torch.zeros(3))
    torch.manual_seed(5)
    assert torch.equal(came, torch.rand(3) ** 2)
    assert step.enabled


def test_what_rounding_does_is_no_difference():
    wanted = torch.randn(1000, generator=torch.Generator().manual_seed(0))
    assert largest_difference([wanted * (1 + 1e-6)], [wanted]) is None
    lonely = wanted.clone()
    lonely[3] += 1
    assert largest_difference([lonely], [wanted]) is None, "one of a thousand, a step of Adam's"
    assert largest_difference([wanted + 1], [wanted]) == pytest.approx(1, rel=1e-6)
    assert largest_difference([torch.tensor([1e-6])], [torch.tensor([2e-6])]) == pytest.approx(1e-6), (
        "small numbers are compared among their like"
    )
    nan = torch.full((3,), torch.nan)
    assert largest_difference([nan], [nan]) is None
    assert largest_difference([torch.ones(3)], [nan]) is not None
