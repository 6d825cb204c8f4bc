"""Programs that tests keep on disk and load in a process of their own: `main` runs one and says what came of it."""

import hashlib
import json
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, PartitionSpec

import jaxphoto  # noqa: F401
from jaxphoto.compiling import description, run, run_compiled

MATRIX = np.diag(np.arange(1.0, 9.0)) + 0.1


@eqx.filter_jit
def root(matrix, power: int):
    """Through LAPACK; with a static argument, and results that are not all arrays."""
    lower = jnp.linalg.cholesky(matrix)
    return {"root": lower**power, "power": power}, (jnp.linalg.eigh(matrix)[0], None)


@eqx.filter_jit
def over_devices(matrix):
    """On every device of the process."""
    mesh = jax.make_mesh((jax.device_count(),), ("rows",), axis_types=(AxisType.Auto,))
    rows = PartitionSpec("rows")

    def total(part):
        return jax.lax.psum(part.sum(0), "rows"), jnp.linalg.inv(part[:4])

    return jax.shard_map(total, mesh=mesh, in_specs=rows, out_specs=(PartitionSpec(), rows))(matrix)


@eqx.filter_jit
def calling_back(matrix):
    """Into Python, which no file can hold."""
    return jax.pure_callback(np.sin, jax.ShapeDtypeStruct(matrix.shape, matrix.dtype), matrix)


@eqx.filter_jit
def checked(matrix):
    """With an error at run time, which also calls back into Python."""
    return eqx.error_if(jnp.asarray(matrix), matrix[0, 0] < 0, "negative")


PROGRAMS = {
    "root": (root, (MATRIX, 2)),
    "over_devices": (over_devices, (MATRIX[:, :4],)),
    "calling_back": (calling_back, (MATRIX,)),
    "checked": (checked, (MATRIX,)),
}


def main() -> None:
    """Run the programs named on the command line; print whether each was loaded, and a hash of its results."""
    description._KNOWN |= {"tests"}
    said = {}
    for name in sys.argv[1:]:
        function, arguments = PROGRAMS[name]
        result = run_compiled(function, arguments, {}, "run")
        (program,) = run._programs.values()
        run._programs.clear()
        leaves, structure = jax.tree.flatten(result)
        digest = hashlib.sha256(b"".join(np.asarray(leaf).tobytes() for leaf in leaves)).hexdigest()
        said[name] = {"loaded": program.loaded, "digest": digest, "structure": str(structure)}
    print(json.dumps(said))
