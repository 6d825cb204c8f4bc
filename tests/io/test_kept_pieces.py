"""Pieces of a long run: back as they were, made anew where they are damaged, alone, and nobody else's files touched."""

import numpy as np
import pytest

from jaxphoto.errors import InputError
from jaxphoto.io.kept_pieces import KeptPieces, beside, check_pieces, name_of


def test_a_piece_comes_back_and_a_damaged_one_does_not(tmp_path):
    pieces = KeptPieces(tmp_path / "a.progress")
    xy, number = np.random.default_rng(1).normal(size=(7, 2)), np.arange(3, dtype=np.uint8)
    pieces.write("one", xy=xy, number=number)
    back = KeptPieces(tmp_path / "a.progress").read("one")
    assert back.keys() == {"xy", "number"} and back["number"].dtype == np.uint8
    assert back["xy"].tobytes() == xy.tobytes() and (back["number"] == number).all()
    assert pieces.read("other") is None
    (file,) = pieces.folder.glob("one*")
    whole = file.read_bytes()
    for spoilt in (whole[:-1], whole[:20], b"", whole[:100] + bytes([whole[100] ^ 1]) + whole[101:]):
        file.write_bytes(spoilt)
        assert pieces.read("one") is None
    pieces.write("one", xy=xy)
    assert pieces.read("one").keys() == {"xy"}


def test_a_name_says_all_that_a_piece_depends_on():
    names = [name_of(*c) for c in (("a", 1), ("a", 2), ("a1",), ("a", b"1"), (b"a1",), ("a", 1.0), ("a", 1, ""))]
    assert len(set(names)) == len(names) and name_of("a", 1) == names[0]


def test_only_pieces_are_removed(tmp_path):
    pieces = KeptPieces(beside(tmp_path / "out"))
    assert pieces.folder == tmp_path / "out.progress"
    pieces.write("one", a=np.zeros(1))
    (pieces.folder / "mine.txt").write_text("mine")
    pieces.remove()
    assert (pieces.folder / "mine.txt").is_file() and pieces.read("one") is None
    (pieces.folder / "mine.txt").unlink()
    pieces.remove()
    assert not list(tmp_path.iterdir())


def test_folders_of_others_and_of_another_run_are_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="is a file"):
        check_pieces(tmp_path / "file")
    with pytest.raises(InputError, match="not jaxphoto's"):
        KeptPieces(tmp_path)
    one, other = KeptPieces(tmp_path / "a"), KeptPieces(tmp_path / "a")
    with one.alone(), pytest.raises(InputError, match="another run uses"), other.alone():
        pass
    with other.alone() as own:
        assert own is other
    # None of them has a piece.
    assert not (tmp_path / "a").exists()


def test_what_is_left_of_a_run_that_is_refused_is_told(tmp_path):
    pieces = KeptPieces(tmp_path / "a")
    with pytest.raises(InputError, match="no") as refused, pieces.alone():
        pieces.write("one", x=np.zeros(3))
        raise InputError("no")
    assert refused.value.__notes__ == [f"checkpoints remain in {tmp_path / 'a'}; the same command continues from them"]
