"""Shapes and types of every function of the package are checked while the tests run."""

import gc
import os
import signal
from pathlib import Path

from tests import typechecker

# Two test processes share two cores: one thread each, and the same floating-point sums on every machine.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# A shell starts jobs in the background deaf to Ctrl-C, which some tests press.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
typechecker.install("tumble")

import pytest  # noqa: E402
import torch  # noqa: E402

torch.set_num_threads(1)

SHARED_DATA = Path(__file__).parents[2] / "shared" / "data"


def pytest_collection_finish() -> None:
    """What was imported stays until the end: no garbage collection during the tests looks at it again."""
    gc.collect()
    gc.freeze()


def pytest_runtest_setup() -> None:
    """The first calls of a function in every test are checked, not those of the first test alone."""
    typechecker.calls.clear()


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real meshes, light maps and clips that lies beside the repository on some machines."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"needs the data folder {SHARED_DATA.parent.name}/{SHARED_DATA.name} beside the repository")
    return SHARED_DATA
