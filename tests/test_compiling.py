"""Programs kept on disk: a second process runs them without tracing, and nothing it should not."""

import dataclasses
import functools
import hashlib
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import SingleDeviceSharding

from jaxphoto.camera import Brown, Brown14
from jaxphoto.collinearity import project
from jaxphoto.compiling import (
    description,
    fast_compilation,
    jit_quickly,
    options,
    plain_tree,
    private_folder,
    run,
    run_compiled,
    store,
)
from jaxphoto.compiling.description import Indescribable, describe
from jaxphoto.compiling.plain_tree import Slot
from tests.compiled_programs import MATRIX, root

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def kept(tmp_path, monkeypatch):
    """Programs of the tests are kept, in a folder of their own; none is compiled yet."""
    monkeypatch.setattr(description, "_KNOWN", description._KNOWN | {"tests"})
    monkeypatch.setattr(store, "_folder", lambda: tmp_path)
    monkeypatch.setattr(run, "_programs", {})
    monkeypatch.setattr(run, "_prepared", {})
    return tmp_path


def in_new_process(*programs: str, **environment: str) -> dict:
    done = subprocess.run(
        [sys.executable, "-c", "from tests.compiled_programs import main; main()", *programs],
        cwd=ROOT, env=os.environ | environment, capture_output=True, text=True, check=True,
    )  # fmt: skip
    return json.loads(done.stdout.splitlines()[-1])


def test_a_second_process_loads_and_gives_the_same_numbers(tmp_path):
    cache = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path), "JAX_NUM_CPU_DEVICES": "2"}
    names = ("root", "over_devices", "calling_back", "checked")
    first, second = (in_new_process(*names, **cache) for _ in range(2))
    assert {name: said["loaded"] for name, said in second.items()} == {
        "root": True, "over_devices": True, "calling_back": False, "checked": False,
    }  # fmt: skip
    assert not any(said["loaded"] for said in first.values())
    for name in names:
        assert first[name] | {"loaded": None} == second[name] | {"loaded": None}
    # Other devices, other programs.
    assert not in_new_process("root", **cache | {"JAX_NUM_CPU_DEVICES": "1"})["root"]["loaded"]


def test_nothing_is_kept_where_the_cache_is_off(tmp_path):
    cache = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path), "JAX_ENABLE_COMPILATION_CACHE": "false"}
    assert not in_new_process("root", **cache)["root"]["loaded"]
    assert not list(tmp_path.iterdir())


def calculate(power: int = 2):
    """The numbers, and whether they came from disk."""
    run._programs.clear()
    result = run_compiled(root, (MATRIX, power), {}, "run")
    (program,) = run._programs.values()
    return np.asarray(result[0]["root"]), program.loaded


def test_a_static_argument_is_part_of_the_key(kept):
    square, _ = calculate(2)
    cube, loaded = calculate(3)
    assert not loaded
    assert not np.allclose(square, cube)
    again, loaded = calculate(2)
    assert loaded
    np.testing.assert_array_equal(again, square)


def entries(folder):
    """The files of programs."""
    return [path for path in folder.iterdir() if path.name != "secret"]


@pytest.mark.parametrize("damage", ["cut", "changed", "empty", "other", "hashed", "unfit", "no JSON", "link", "pipe"])
def test_a_damaged_file_is_written_anew(kept, damage):
    right, _ = calculate()
    (path,) = entries(kept)
    content = path.read_bytes()
    path.unlink()
    if damage == "link":
        (kept / "elsewhere").write_bytes(content)
        path.symlink_to(kept / "elsewhere")
    elif damage == "pipe":
        os.mkfifo(path)
    elif damage in ("unfit", "no JSON"):
        text = b'{"program": {}, "skeleton": null}' if damage == "unfit" else b"x"
        private_folder.write(kept, path.name, len(text).to_bytes(8, "big") + text)
    else:
        path.write_bytes(
            {
                "cut": content[:-100],
                "changed": content[:82] + b"x" + content[83:],
                "empty": b"",
                "other": b"something else",
                # By what everybody knows, and not by the secret.
                "hashed": hashlib.sha256(content[32:]).digest() + content[32:],
            }[damage]
        )
    again, loaded = calculate()
    assert not loaded
    np.testing.assert_array_equal(again, right)
    assert calculate()[1]


def test_a_program_under_another_name_is_not_taken_for_it(kept):
    square, _ = calculate(2)
    (first,) = entries(kept)
    calculate(3)
    (second,) = set(entries(kept)) - {first}
    first.write_bytes(second.read_bytes())
    again, loaded = calculate(2)
    assert not loaded
    np.testing.assert_array_equal(again, square)


def test_what_others_could_have_written_is_not_run(kept, monkeypatch):
    calculate()
    (path,) = entries(kept)
    path.chmod(0o666)
    assert not calculate()[1]
    # A folder that others could look into is closed to them; one that is theirs is let alone.
    kept.chmod(0o777)
    assert calculate()[1]
    assert kept.stat().st_mode & 0o777 == 0o700
    before = path.read_bytes()
    monkeypatch.setattr(os, "getuid", lambda: kept.stat().st_uid + 1)
    assert not calculate()[1]
    assert path.read_bytes() == before
    monkeypatch.undo()


def test_nothing_that_is_read_runs_by_itself():
    """No module of jaxphoto reads pickles, which may be anybody's.

    Workers read those of their own Dask client, on whose behalf Dask runs any code.
    """
    for path in {*(ROOT / "jaxphoto").rglob("*.py")} - {ROOT / "jaxphoto" / "workers.py"}:
        words = set(re.findall(r"\w+", path.read_text()))
        assert not words & {"unpickle", "cPickle", "dill", "cloudpickle", "joblib", "marshal", "read_pickle"}, path
        assert "import pickle" not in path.read_text(), path


def test_a_tree_is_told_and_comes_back():
    tree = {"a": [None, True, 2, 0.1, float("inf"), "x"], "b": (Slot(), jax.tree.map(lambda _: Slot(), Brown()))}
    again = plain_tree.from_json(json.loads(json.dumps(plain_tree.to_json(tree))))
    assert [*map(type, again["b"])] == [Slot, Brown]
    assert again["a"] == tree["a"]
    assert isinstance(again["b"][1].k1, Slot)
    assert jax.tree.structure(again) == jax.tree.structure(tree)
    for unknown in (Own(), object(), {1: 2}, lambda x: x, np.zeros(2), Brown):
        with pytest.raises(TypeError):
            plain_tree.to_json(unknown)
    for name in ("os:system", "jaxphoto:read_block", "jaxphoto.io:read_block", "builtins:list"):
        with pytest.raises(TypeError):
            plain_tree.from_json({name: []})


@pytest.mark.parametrize("error", [jax.errors.JaxRuntimeError, TypeError])
def test_a_program_that_fails_when_called_is_compiled_anew(kept, monkeypatch, error):
    right, _ = calculate()
    load = store.load

    def broken(*_):
        raise error("NOT_FOUND: Function kernel not found")

    monkeypatch.setattr(store, "load", lambda key: load(key)._replace(compiled=broken))
    again, loaded = calculate()
    assert not loaded
    np.testing.assert_array_equal(again, right)


def test_what_cannot_be_written_is_compiled(kept, monkeypatch):
    monkeypatch.setattr(store, "_folder", lambda: kept / "file" / "below")
    (kept / "file").write_text("in the way")
    assert not calculate()[1]
    assert not calculate()[1]


def test_what_was_not_used_for_longest_goes_first(kept, monkeypatch):
    calculate(2)
    (first,) = entries(kept)
    calculate(3)
    (kept / "tmp123").write_text("half")
    for path in entries(kept):
        os.utime(path, (1, 1) if path == first else (2, 2))
    assert calculate(2)[1]
    monkeypatch.setattr(store, "MOST", 2.5 * first.stat().st_size)
    calculate(4)
    assert len(entries(kept)) == 2
    assert calculate(2)[1]
    assert calculate(4)[1]
    assert not calculate(3)[1]


def test_the_threshold_of_the_cache_stays(kept):
    before = jax.config.values[run._THRESHOLD]
    calculate()
    assert jax.config.values[run._THRESHOLD] == before


def test_what_was_not_used_for_longest_is_let_go(kept, monkeypatch):
    monkeypatch.setattr(run, "MOST", 2)
    for power in (2, 3, 2, 4):
        run_compiled(root, (MATRIX, power), {}, "run")
    assert [key[3] for key in run._programs] == [(None, 2), (None, 4)]


def test_jax_forgets_traces_when_as_many_programs_have_gone_as_are_kept(kept, monkeypatch):
    monkeypatch.setattr(run, "MOST", 2)
    monkeypatch.setattr(run, "_gone", 0)
    traced: list[int] = []

    def seen(x):
        traced.append(1)
        return x + 1.0

    other = jax.jit(seen)
    counts = []
    for power in range(2, 8):
        run_compiled(root, (MATRIX, power), {}, "run")
        other(1.0)
        counts.append(len(traced))
    # The fourth program and the sixth are those with which two have gone.
    assert counts == [1, 1, 1, 2, 2, 3]


def test_shapes_of_what_runs_once_are_forgotten(monkeypatch):
    monkeypatch.setattr(fast_compilation, "_SHAPES", 3)
    traced = []

    @jit_quickly
    def seen(x):
        traced.append(len(x))
        return 2 * x

    for n in (1, 2, 3, 3, 4, 1):
        np.testing.assert_array_equal(seen(np.ones(n)), np.full(n, 2.0))
    # The fourth shape is one too many: all are forgotten before the next.
    assert traced == [1, 2, 3, 4, 1]


def test_a_jaxlib_without_an_option_is_not_given_it(kept, monkeypatch):
    """What compiles without any option gives the same numbers."""
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    real = {"xla_backend_optimization_level": 0}
    monkeypatch.setattr(options, "_ADJUSTMENT", real | {"xla_no_such_option": True})
    assert options.options_here() == real
    first = run_compiled(root, (MATRIX, 2), {}, "run")[0]["root"]
    monkeypatch.setattr(options, "_are_known", lambda options: False)
    assert options.options_here() == options.quick_to_compile() == {}
    run._programs.clear()
    again = run_compiled(root, (MATRIX, 2), {}, "run")[0]["root"]
    np.testing.assert_allclose(again, first, rtol=1e-14)


@pytest.mark.skipif(sys.platform != "linux", reason="only glibc keeps what is freed")
def test_freed_memory_goes_back():
    # A process of its own: what others left free would hide it. Pieces below the size that gets pages of its own.
    done = subprocess.run(
        [sys.executable, "-c", FREED], cwd=ROOT, capture_output=True, text=True, check=True, timeout=300
    )
    kept, returned = map(float, done.stdout.split())
    assert kept > 150
    assert returned < 20


FREED = """
import ctypes, os
from jaxphoto.compiling.freed_memory import return_freed_memory

def resident_mb():
    return int(open("/proc/self/statm").read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6

libc = ctypes.CDLL(None)
libc.malloc.restype, libc.free.argtypes = ctypes.c_void_p, [ctypes.c_void_p]
return_freed_memory()
before = resident_mb()
pieces = [libc.malloc(60_000) for _ in range(4000)]
for piece in pieces:
    ctypes.memset(piece, 1, 60_000)
# The last stays, so that the rest lies below something.
for piece in pieces[:-1]:
    libc.free(piece)
kept = resident_mb() - before
return_freed_memory()
print(kept, resident_mb() - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only glibc keeps what is freed")
def test_what_is_freed_is_kept_for_the_same_again_and_goes_back_at_the_end():
    done = subprocess.run(
        [sys.executable, "-c", KEPT], cwd=ROOT, capture_output=True, text=True, check=True, timeout=300
    )
    usual, kept, after_mb = map(float, done.stdout.split())
    # Of ten rounds all ask for their pages anew, or the first alone, which would be a tenth.
    assert kept < 0.2 * usual
    assert after_mb < 50


KEPT = """
import os, resource
from concurrent.futures import ThreadPoolExecutor
from jaxphoto_command import share_one_pool
share_one_pool()
import numpy as np
from jaxphoto.compiling.freed_memory import freed_memory_kept

def resident_mb():
    return int(open("/proc/self/statm").read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    # 100 MB in a thread, which has no pool of its own.
    with ThreadPoolExecutor(1) as worker:
        for _ in range(10):
            worker.submit(np.full, 12_500_000, 1.0).result()
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

usual, before = faults(), resident_mb()
with freed_memory_kept():
    kept = faults()
print(usual, kept, resident_mb() - before)
"""


def test_prepared_programs_are_used(kept, monkeypatch):
    seconds: dict[str, float] = {}
    run.prepare(root, (MATRIX, 5), seconds)
    monkeypatch.setattr(run, "_program_of", None)
    result = run_compiled(root, (MATRIX, 5), seconds, "run")
    np.testing.assert_allclose(result[0]["root"], np.linalg.cholesky(MATRIX) ** 5)
    assert set(seconds) == {"compile", "run"}
    assert not run._prepared


def test_under_a_transformation_it_is_a_plain_call(kept):
    gradient = jax.grad(lambda x: run_compiled(root, (x * MATRIX, 2), {}, "run")[0]["root"].sum())(1.0)
    assert np.isfinite(gradient)
    assert not run._programs


@dataclasses.dataclass
class Own:
    """Of a module whose sources are not part of the key."""

    value: float = 0.0


def test_what_differs_is_described_differently():
    one = np.zeros(3)
    different = [
        None, 0, False, 0.0, -0.0, "", "0", b"", (), [], {}, (0,), [0], {"a": 0}, {"a": 0.0}, {"b": 0}, ((0,),), (0, 0),
        float("nan"), float("inf"), one, one.astype(np.float32), one.astype(int), one[:2], one[None], (one, one),
        jnp.asarray(1.0), jnp.asarray(1.0, jnp.float64), jax.device_put(one, SingleDeviceSharding(jax.devices()[0])),
        Brown(), Brown(k1=jnp.asarray(0.5)), Brown14(f=1.0), Brown, Brown14, project,
        jax.tree.structure((0, 0)), jax.tree.structure([0, 0]),
        jax.tree.structure(Brown()), eqx.Module, np.dtype(float), np.dtype(int), "None", "0.0", "(0,)",
    ]  # fmt: skip
    texts = [describe(value) for value in different]
    assert len(set(texts)) == len(texts)
    assert describe(one) == describe(jnp.asarray(one)) == describe(one + 1)
    assert not any(" at 0x" in text for text in texts)


@pytest.mark.parametrize(
    "value", [Own(), lambda x: x, functools.partial(project), object(), {1, 2}, eqx.filter_jit(project), iter(())]
)
def test_what_a_name_does_not_tell_is_not_described(value):
    with pytest.raises(Indescribable):
        describe((0, value))


def test_settings_are_part_of_the_key(kept, monkeypatch):
    def key():
        return store.key_of(root.__wrapped__, (MATRIX, 2), None)

    keys = [key()]
    with jax.enable_x64(False):
        keys.append(key())
    with jax.default_matmul_precision("float32"):
        keys.append(key())
    monkeypatch.setenv("XLA_FLAGS", os.environ.get("XLA_FLAGS", "") + " --xla_cpu_enable_fast_math=true")
    keys.append(key())
    monkeypatch.setattr(store, "_SOURCES", "other sources")
    store._surroundings.cache_clear()
    keys.append(key())
    monkeypatch.undo()
    store._surroundings.cache_clear()
    assert len(set(keys)) == 5
    assert None not in keys
