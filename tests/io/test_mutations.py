"""Corrupt files are read as they stand or refused in one sentence."""

import pytest

from tests.mutations import READERS, tried


@pytest.mark.parametrize("count", [8, pytest.param(200, marks=pytest.mark.slow)])
@pytest.mark.parametrize("reader", READERS)
def test_corrupt_files_are_read_or_refused(tmp_path, reader, count):
    found = {seed: errors for seed in range(count) if (errors := tried(reader, seed, tmp_path / "corrupt"))}
    assert not found, found
