"""What the diagnosis frees stays with the process."""

import platform
import subprocess
import sys

import pytest

FREE_AND_TAKE = """
import resource, sys
import numpy as np
from visthrow.diagnose.likelihood import threads
if sys.argv[1] == "kept":
    threads.keep()
def faults():
    # 16 MB in pieces that malloc maps or trims by default
    arrays = [np.ones(100_000) for _ in range(20)]
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt
first = faults()
for _ in range(20):
    last = faults()
print(last - first)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library has other habits")
def test_pages_are_not_given_back():
    plain, kept = (
        int(
            subprocess.run(
                [sys.executable, "-c", FREE_AND_TAKE, how],
                capture_output=True,
                text=True,
                check=True,
            ).stdout
        )
        for how in ("plain", "kept")
    )
    assert kept < 0.1 * plain
