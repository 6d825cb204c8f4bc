"""Files spoilt at random are read as they stand or refused in one sentence, with little memory."""

import pytest

from tests.mutations import READERS, tried

# Of each reader; `benchmarks/mutations.py` tries thousands.
FEW, MANY = 20, 200


def findings(reader: str, count: int, folder) -> list:
    """All but slowness, which the script measures: a test has no clock."""
    tries = (tried(reader, seed, folder / "spoilt") for seed in range(count))
    return [finding for found in tries for finding in found if finding.what != "slow"]


@pytest.mark.parametrize("reader", READERS)
def test_spoilt_files_are_read_or_refused(tmp_path, reader):
    found = findings(reader, FEW, tmp_path)
    assert not found, f"{len(found)} findings, first: {found[0]}"


@pytest.mark.slow
@pytest.mark.parametrize("reader", READERS)
def test_many_spoilt_files_are_read_or_refused(tmp_path, reader):
    found = findings(reader, MANY, tmp_path)
    assert not found, f"{len(found)} findings, first: {found[0]}"
