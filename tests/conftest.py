"""Fixtures for all tests."""

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real measurements; a test that needs it is skipped where it is absent."""
    root = Path(__file__).resolve().parents[1]
    folder = (root / os.environ.get("JAXPHOTO_DATA", "../shared/data")).resolve()
    if not folder.is_dir():
        pytest.skip(
            f"no real measurements in {folder}: set JAXPHOTO_DATA to the folder that holds sxb, camcal and aicon"
        )
    return folder
