"""Counter-based random numbers: the published test vectors, and thresholds."""

import numpy as np
import pytest

from cprl.commons.chance import philox4x32
from cprl.institutions.base import threshold

KNOWN_ANSWERS = [  # from the vectors published with Random123, philox4x32, 10 rounds
    ("00000000 00000000 00000000 00000000", "00000000 00000000", "6627e8d5 e169c58d bc57ac4c 9b00dbd8"),
    ("ffffffff ffffffff ffffffff ffffffff", "ffffffff ffffffff", "408f276d 41c83b0e a20bc7c6 6d5451fd"),
    ("243f6a88 85a308d3 13198a2e 03707344", "a4093822 299f31d0", "d16cfe09 94fdcceb 5001e420 24126ea1"),
]


def words(text):
    return [np.uint64(int(word, 16)) for word in text.split()]


@pytest.mark.parametrize(("counter", "key", "answer"), KNOWN_ANSWERS)
def test_philox_gives_the_known_answers(counter, key, answer):
    assert list(philox4x32(*words(counter), *words(key))) == words(answer)


@pytest.mark.parametrize(("counter", "key", "answer"), KNOWN_ANSWERS)
def test_the_compiled_philox_gives_the_known_answers(counter, key, answer):
    import numba

    assert list(numba.njit(philox4x32)(*words(counter), *words(key))) == words(answer)


def test_a_threshold_is_the_probability_of_a_word_below_it():
    assert threshold(0.0) == 0
    assert threshold(1.0) == 2**32
    assert threshold(0.01) / 2**32 == pytest.approx(0.01, abs=2**-33)
