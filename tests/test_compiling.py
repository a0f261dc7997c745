"""Compiled: the same as the plain function, whatever form its arguments take."""

import torch

from cprl.compiling import Compiled


def scaled_in_place(owner, values, factor):
    values.mul_(factor)
    return values.sum() + owner.offset


class Owner:
    offset = 1.0


def test_what_is_compiled_is_called_directly_and_compiled_again_for_another_form():
    step = Compiled(scaled_in_place, what="steps run")
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


def test_two_of_one_function_do_not_disturb_each_other():
    small, large = (Compiled(scaled_in_place, what="steps run") for _ in range(2))
    factor = torch.tensor(3.0)
    for _ in range(2):
        assert small((), Owner, torch.ones(2), factor) == 7
        assert large((), Owner, torch.ones(4), factor) == 13
