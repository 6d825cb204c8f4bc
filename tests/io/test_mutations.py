"""Files spoilt at random are read as they stand or refused in one sentence, soon and with little memory."""

import pytest

from tests.mutations import READERS, tried

# Of each reader; `benchmarks/mutations.py` tries thousands.
FEW, MANY = 20, 1000


def findings(reader: str, count: int, folder) -> list:
    return [finding for seed in range(count) for finding in tried(reader, seed, folder / "spoilt")]


@pytest.mark.parametrize("reader", READERS)
def test_spoilt_files_are_read_or_refused(tmp_path, reader):
    found = findings(reader, FEW, tmp_path)
    assert not found, f"{len(found)} findings, first: {found[0]}"


@pytest.mark.slow
@pytest.mark.parametrize("reader", READERS)
def test_many_spoilt_files_are_read_or_refused(tmp_path, reader):
    found = findings(reader, MANY, tmp_path)
    assert not found, f"{len(found)} findings, first: {found[0]}"
