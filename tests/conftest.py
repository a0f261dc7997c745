"""What the tests share: small boards that are never square, and a quiet, seeded torch."""

import pytest
import torch


@pytest.fixture(autouse=True)
def seeded_torch() -> None:
    """TorchRL's modules draw from torch's global generator; every test starts it anew."""
    torch.manual_seed(0)
    torch.set_num_threads(1)
