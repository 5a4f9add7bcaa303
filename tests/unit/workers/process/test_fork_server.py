"""Forked processes draw random numbers of their own."""

import subprocess
import sys

TWO_FORKS = """
import os
import sys
import numpy as np
from workers.process.fork_server import draw_anew

for _ in range(2):
    if os.fork() == 0:
        if sys.argv[1] == "anew":
            draw_anew()
        print(np.random.random(), flush=True)
        os._exit(0)
    os.wait()
"""


def drawn(how: str) -> list[str]:
    done = subprocess.run(
        [sys.executable, "-c", TWO_FORKS, how], capture_output=True, text=True, check=True
    )
    return done.stdout.split()


def test_an_fmu_in_python_does_not_draw_the_same_in_each_process() -> None:
    """With the state that forks inherit it would, and seem to repeat."""
    one, other = drawn("inherited")
    assert one == other
    one, other = drawn("anew")
    assert one != other
