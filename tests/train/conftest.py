"""One thread for torch in every test of training."""

import pytest
import torch


@pytest.fixture(autouse=True)
def one_thread():
    """The same bits need the same number of threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
