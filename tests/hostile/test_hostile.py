"""Hostile inputs: every case ends with one line that names the file and the rule, quickly, in little memory, and
without a file outside of the output folder. A fixed sample runs with all tests, the whole suite with the slow ones.
"""

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.hostile import documents, films, light_maps, models, pictures, runs
from tests.hostile.cases import Case

FAMILIES = {
    "pictures": pictures.cases,
    "films": films.cases,
    "documents": documents.cases,
    "models": models.cases,
    "light maps": light_maps.cases,
    "runs": runs.cases,
}
CASES = {f"{family}: {case.name}": case for family, cases in FAMILIES.items() for case in cases()}
N_SAMPLED = 60
"""Number of cases that run with all tests."""
SMALL = [name for name, case in CASES.items() if not case.large]
SAMPLE = SMALL[:: len(SMALL) // N_SAMPLED][:N_SAMPLED]
MAX_BYTES = 2 << 30
"""Maximum memory of a case, with the 400 MiB of the libraries [bytes]."""
MAX_SECONDS = 20
"""Maximum time of a case [s]."""


@pytest.fixture(scope="module")
def server() -> Iterator[subprocess.Popen[str]]:
    """A process that has imported the package."""
    command = [sys.executable, "-m", "tests.hostile.server"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdin is not None
        assert json.loads(process.stdout.readline()) == "ready"
        yield process
        process.stdin.close()


def assert_refused(server: subprocess.Popen[str], case: Case, folder: Path) -> None:
    """Run a case in a folder and check everything that is promised."""
    assert server.stdin is not None
    assert server.stdout is not None
    case.write(folder)
    before = set(folder.rglob("*"))
    request = {"words": case.words, "folder": str(folder), "seconds": MAX_SECONDS}
    server.stdin.write(json.dumps(request) + "\n")
    server.stdin.flush()
    answer = json.loads(server.stdout.readline())
    error = answer["error"].strip()
    assert "Traceback" not in error, error[-2000:]
    assert answer["code"] in (case.code, *case.also), error
    if answer["code"] == 1:
        *progress, error = error.splitlines()
        assert all(line.startswith("tumble: converting ") for line in progress), progress
        assert error.startswith("tumble: ")
    if answer["code"] == case.code:
        assert re.search(case.says, error), error
    created = {path for path in set(folder.rglob("*")) - before if not path.is_relative_to(folder / "out")}
    assert not created
    assert not list(folder.rglob(".partial-*"))
    assert answer["bytes"] < MAX_BYTES
    assert answer["seconds"] < MAX_SECONDS


@pytest.mark.parametrize("name", SAMPLE)
def test_a_sample_of_hostile_inputs_is_refused(name: str, server: subprocess.Popen[str], tmp_path: Path) -> None:
    assert_refused(server, CASES[name], tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in CASES if name not in SAMPLE])
def test_hostile_inputs_are_refused(name: str, server: subprocess.Popen[str], tmp_path: Path) -> None:
    assert_refused(server, CASES[name], tmp_path)


def test_there_are_many_cases() -> None:
    assert len(CASES) >= 300
    assert len(SAMPLE) == N_SAMPLED
