"""The numerical reference notices what it is there for."""

import numpy as np
import pytest

from benchmarks import yardstick
from tests.blocks import simulated

LIMIT = 1e-9


@pytest.fixture
def tiny(monkeypatch):
    monkeypatch.setitem(yardstick.CASES, "tiny", lambda: {"cross": simulated("cross").block})
    return "tiny"


def test_an_unchanged_case_passes_and_a_change_of_a_millionth_is_noticed(tiny, tmp_path, capsys):
    assert yardstick.store([tiny], tmp_path) == 0
    assert yardstick.compare([tiny], LIMIT, tmp_path) == 0
    path = tmp_path / f"{tiny}.npz"
    with np.load(path) as file:
        stored = {part.partition("|")[2]: v for part, v in file.items()}
    sigmas = {part.partition(".")[2]: v for part, v in stored.items() if part.startswith("sigmas.")}
    # Of every kind the change of its unit.
    changes = {
        "sigma0": stored["sigma0"] * 1e-6,
        "unknowns.shared": sigmas["shared"] * 1e-6,
        "unknowns.position": sigmas["position"] * 1e-6,
        "sigmas.points": stored["sigmas.points"] * 1e-6,
        "correlations.all": np.full_like(stored["correlations.all"], 1e-6),
        "redundancy.image_points": np.full_like(stored["redundancy.image_points"], 1e-6),
        "draws.1.points": 1e-6,
        "derivatives.stations": stored["derivatives.stations"] * 1e-6,
    }
    for part, change in changes.items():
        kind = part.partition(".")[0]
        moved = stored | {part: stored[part] + change}
        found = {p: off for _, p, off in yardstick.compared(stored, moved)}
        assert found.pop(part) > 0.9e-6, kind
        assert kind == "sigmas" or max(found.values()) < LIMIT, kind
    np.savez_compressed(
        path, **{f"cross|{part}": v for part, v in (stored | {"sigma0": stored["sigma0"] + 1e-6}).items()}
    )
    assert yardstick.compare([tiny], LIMIT, tmp_path) == 1
    assert "EXCEEDS" in capsys.readouterr().out


def test_a_rotation_counts_in_its_standard_deviations():
    about_z = lambda angle: np.array([[np.cos(angle), -np.sin(angle), 0, np.sin(angle), np.cos(angle), 0, 0, 0, 1]])  # noqa: E731
    then = {"unknowns.rotation": about_z(0.3), "sigmas.rotation": np.array([[1e-3, 1e-3, 2e-4]])}
    now = then | {"unknowns.rotation": about_z(0.3 + 2e-10)}
    found = {part: off for _, part, off in yardstick.compared(now, then)}
    assert found["unknowns.rotation"] == pytest.approx(1e-6, rel=1e-5)


def test_what_fails_or_is_not_stored_is_no_success(tiny, tmp_path, monkeypatch):
    assert yardstick.compare([tiny], LIMIT, tmp_path) == 1

    def broken():
        raise yardstick.NoDataError("no measurements")

    monkeypatch.setitem(yardstick.CASES, "real", broken)
    np.savez_compressed(tmp_path / "real.npz", x=np.zeros(1))
    assert yardstick.compare(["real"], LIMIT, tmp_path) == 0
