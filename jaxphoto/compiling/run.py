"""Execution of compiled functions, with separate compile and run times; compiled at most once per process.

Tracing and lowering require Python's global interpreter lock; compiling releases it. Programs that are needed soon
(`prepare`) are compiled on another core meanwhile.
"""

import contextlib
import os
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.monitoring

from jaxphoto.compiling import store
from jaxphoto.compiling.freed_memory import keep_freed_memory, return_freed_memory
from jaxphoto.compiling.options import Options, options_here
from jaxphoto.compiling.plain_tree import Slot


class _Program(NamedTuple):
    """Compiled function of arrays, and the tree of its results: leaves that are `Slot` are arrays."""

    compiled: jax.stages.Compiled
    leaves: list
    structure: jax.tree_util.PyTreeDef
    loaded: bool

    def __call__(self, arrays: list) -> Any:
        """Run the program and wait for the result."""
        found = iter(jax.block_until_ready(self.compiled(*arrays)))
        leaves = [next(found) if isinstance(leaf, Slot) else leaf for leaf in self.leaves]
        return jax.tree.unflatten(self.structure, leaves)


WAITED = "/jaxphoto/compile_wait_duration"
"""Record of JAX's monitoring: time that a caller waited for the compilation of a program, in seconds."""
# Maximum number of programs cached by a process; then the least recently used is dropped. A large program uses 300 of
# the 65,530 memory mappings that Linux gives a process; a process without free mappings crashes.
MOST = 100
_programs: dict[object, _Program] = {}
_gone = 0
"""Number of programs dropped since the last `jax.clear_caches`."""
_prepared: dict[object, Future[_Program | None]] = {}
_lock = threading.Lock()
_workers = ThreadPoolExecutor(max_workers=os.cpu_count(), thread_name_prefix="jaxphoto-compile")
keep_freed_memory()


def run_compiled(function: Any, arguments: tuple, seconds: dict[str, float], name: str, thorough: bool = False) -> Any:
    """Call `function` (of `eqx.filter_jit`), first compiling it or loading it from disk (`store`).

    Adds to `seconds["compile"]` the time of compiling or loading, and to `seconds[name]` the time of the call.
    `thorough` compilation is useful for programs that run thousands of times. Under a transformation of JAX it is a
    plain call.
    """
    began = time.perf_counter()
    found = _key_and_arrays(function, arguments, thorough)
    if found is None:
        return function(*arguments)
    key, arrays = found
    with _lock:
        prepared, program = _prepared.pop(key, None), _programs.get(key)
    new = program is None
    if prepared is not None:
        program = prepared.result()
    elif program is None:
        program = _program_of(function.__wrapped__, arguments, thorough)()
    if program is None:
        program = _recompiled(function.__wrapped__, arguments, thorough)
    _keep(key, program)
    ready = time.perf_counter()
    try:
        result = program(arrays)
    except Exception:
        # A valid file may still fail on this machine: this appears only in the call, as various errors.
        if not program.loaded:
            raise
        program = _recompiled(function.__wrapped__, arguments, thorough)
        _keep(key, program)
        ready = time.perf_counter()
        result = program(arrays)
    if new and not program.loaded:
        jax.monitoring.record_event_duration_secs(WAITED, ready - began)
    seconds["compile"] = seconds.get("compile", 0.0) + ready - began
    seconds[name] = seconds.get(name, 0.0) + time.perf_counter() - ready
    return result


def call_compiled(function: Any, *arguments: Any, thorough: bool = False) -> Any:
    """Call `run_compiled` without timing, for functions that would otherwise be traced in each process."""
    return run_compiled(function, arguments, {}, "", thorough)


def prepare(function: Any, arguments: tuple, seconds: dict[str, float]) -> bool:
    """Load or compile `function` in the background for a later `run_compiled` with arguments of these types.

    Adds to `seconds["compile"]` the time that the caller waits. Returns True if anything is left to compile.
    """
    began = time.perf_counter()
    found = _key_and_arrays(function, arguments, thorough=False)
    if found is None:
        return False
    key, _ = found
    new = key not in _programs
    if new and key not in _prepared:
        _prepared[key] = _workers.submit(_program_of(function.__wrapped__, arguments, thorough=False))
    seconds["compile"] = seconds.get("compile", 0.0) + time.perf_counter() - began
    return new


def _keep(key: object, program: _Program) -> None:
    """Cache `program` as the most recently used; drop the least recently used beyond `MOST`.

    JAX caches its own traces of each program, some MB. They are cleared after `MOST` programs have been dropped. This
    also clears the functions that the calling process has compiled; they are recompiled when called.
    """
    global _gone
    with _lock:
        _programs.pop(key, None)
        _programs[key] = program
        while len(_programs) > MOST:
            del _programs[next(iter(_programs))]
            _gone += 1
        if _gone >= MOST:
            _gone = 0
            jax.clear_caches()


def _key_and_arrays(function: Any, arguments: tuple, thorough: bool) -> tuple[object, list] | None:
    """Return the key of a program within this process, and its array arguments; None if any is traced.

    Both are computed together, because flattening the arguments takes most of the time.
    """
    leaves, structure = jax.tree.flatten(arguments)
    if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
        return None
    arrays = [leaf for leaf in leaves if eqx.is_array(leaf)]
    others = tuple(None if eqx.is_array(leaf) else leaf for leaf in leaves)
    return (function, structure, tuple(map(_type, arrays)), others, thorough), arrays


def _type(array: Any) -> tuple:
    if not isinstance(array, jax.Array):
        return array.shape, array.dtype, False, None
    return array.shape, array.dtype, array.weak_type, array.sharding if array.committed else None


def _program_of(function: Any, arguments: tuple, thorough: bool) -> Callable[[], _Program | None]:
    """Return a function that loads the program from disk (None if it is invalid), or compiles and stores it.

    All steps that depend on the thread, such as `with jax.enable_x64(False)`, are completed before this returns.
    """
    options = options_here(thorough)
    key = store.key_of(function, arguments, options)
    content = store.read(key) if key else None
    if content is None:
        return _compilation_of(function, arguments, options, key)

    def loaded() -> _Program | None:
        stored = store.load(content)
        return_freed_memory()
        return stored and _Program(stored.compiled, *jax.tree.flatten(stored.skeleton), loaded=True)

    return loaded


def _recompiled(function: Any, arguments: tuple, thorough: bool) -> _Program:
    """Compile and store a program whose file is invalid."""
    options = options_here(thorough)
    return _compilation_of(function, arguments, options, store.key_of(function, arguments, options))()


def _compilation_of(
    function: Any, arguments: tuple, options: Options | None, key: str | None
) -> Callable[[], _Program]:
    """Return a function that compiles the program and stores it as `key`."""
    lowered, skeleton = _lowered(function, arguments)

    def compiled() -> _Program:
        with _not_in_cache() if key else contextlib.nullcontext():
            program = lowered.compile(compiler_options=options)  # type: ignore[arg-type]
        if key:
            store.save(key, store.Stored(program, skeleton))
        return_freed_memory()
        return _Program(program, *jax.tree.flatten(skeleton), loaded=False)

    return compiled


def _lowered(function: Any, arguments: tuple) -> tuple[jax.stages.Lowered, Any]:
    """Lower `function` as a function from list of arrays to list of arrays, which JAX can serialise; also return its
    result tree.
    """
    dynamic, static = eqx.partition(arguments, eqx.is_array)
    arrays, structure = jax.tree.flatten(dynamic)
    skeleton: Any = None

    def flat(*arrays):
        nonlocal skeleton
        result = function(*eqx.combine(jax.tree.unflatten(structure, arrays), static))
        skeleton = jax.tree.map(lambda leaf: Slot() if eqx.is_array(leaf) else leaf, result)
        return [leaf for leaf in jax.tree.leaves(result) if eqx.is_array(leaf)]

    # Use a different name: JAX's cache must not substitute its entry of `function` (`_not_in_cache`).
    flat.__name__ = f"{function.__name__}_of_arrays"
    return jax.jit(flat).lower(*arrays), skeleton


_THRESHOLD = "jax_persistent_cache_min_compile_time_secs"
_kept_out: list[float] = []
"""Value of the user's threshold, once per compilation in progress in `_not_in_cache`."""


@contextlib.contextmanager
def _not_in_cache() -> Iterator[None]:
    """Exclude a compilation from JAX's cache: XLA cannot serialise a CPU program loaded from there."""
    with _lock:
        _kept_out.append(_kept_out[0] if _kept_out else jax.config.values[_THRESHOLD])
        jax.config.update(_THRESHOLD, float("inf"))
    try:
        yield
    finally:
        with _lock:
            before = _kept_out.pop()
            if not _kept_out:
                jax.config.update(_THRESHOLD, before)
