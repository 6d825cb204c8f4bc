"""Compiled CPU program as plain JSON and the bytes that XLA serialises, and back.

`jax.experimental.serialize_executable` uses pickle, which executes code on reading. Here XLA reads all data except
JSON. The types are internal to JAX: in a version with different types, nothing is stored and everything is compiled.
"""

import base64
from typing import Any, NamedTuple, cast

import jax
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec, SingleDeviceSharding

try:
    from jax._src.interpreters.pxla import UnloadedMeshExecutable
    from jax._src.lib import xla_client
    from jax._src.sharding_impls import GSPMDSharding
except ImportError:  # Other JAX version: `as_plain` and `program_of` fail, and callers compile instead.
    pass

_NOTHING: dict[str, Any] = {
    "unordered_effects": [], "ordered_effects": [], "keepalive": [], "host_callbacks": [], "mut": None,
    "pgle_profiler": None,
}  # fmt: skip
"""Attributes that are empty if a program depends only on its arguments."""


class PlainProgram(NamedTuple):
    """Stored form of a program: JSON `text` and the bytes that XLA serialises."""

    text: dict[str, Any]
    executable: bytes


def as_plain(program: jax.stages.Compiled) -> PlainProgram:
    """Serialise a program. Raises TypeError if it cannot be stored, and any error of JAX and XLA."""
    executable: Any = program._executable
    inner = executable._unloaded_executable
    if any(getattr(inner, name) for name in _NOTHING) or program._params.const_args:
        raise TypeError("cannot serialise a program with host callbacks or constant arrays; compile it in each process")
    if any(layout is not None for layout in inner.dispatch_in_layouts):
        raise TypeError("cannot serialise a program with custom argument layouts; compile it in each process")
    text = {
        "name": inner.name,
        "committed": inner.committed,
        "devices": [int(device.id) for device in inner.device_list],
        "used": sorted(inner.kept_var_idx),
        "arguments": [
            {"type": _type(a), "sharding": _sharding(s)}
            for a, s in zip(inner.input_avals, inner.input_shardings, strict=True)
        ],
        "results": [
            {"type": _type(a), "sharding": _sharding(s)}
            for a, s in zip(inner.output_avals, inner.output_shardings, strict=True)
        ],
        "all": [_type(info._aval) for info in jax.tree.leaves(program.args_info)],
    }
    return PlainProgram(text, inner.xla_executable.client.serialize_executable(inner.xla_executable))


def program_of(plain: PlainProgram) -> jax.stages.Compiled:
    """Deserialise a program that maps a list of arrays to a list of arrays. Raises various errors if `plain` is
    invalid.
    """
    devices_here: list[Any] = jax.devices()
    text, by_id = plain.text, {device.id: device for device in devices_here}
    devices = xla_client.DeviceList(tuple(by_id[number] for number in text["devices"]))
    client = devices_here[0].client
    arguments, results = text["arguments"], text["results"]
    inner = UnloadedMeshExecutable(
        xla_executable=client.deserialize_executable(plain.executable, executable_devices=devices),
        device_list=devices,
        backend=client,
        input_avals=[_aval(one["type"]) for one in arguments],
        input_shardings=[_sharding_of(one["sharding"], by_id) for one in arguments],
        output_avals=[_aval(one["type"]) for one in results],
        output_shardings=[_sharding_of(one["sharding"], by_id) for one in results],
        committed=text["committed"],
        name=text["name"],
        kept_var_idx=set(text["used"]),
        xla_in_layouts=[None] * len(arguments),
        dispatch_in_layouts=[None] * len(arguments),
        xla_out_layouts=[None] * len(results),
        all_args_info=None,
        **_NOTHING,
    )
    infos = tuple(jax.stages.ArgInfo(_aval(one), False) for one in text["all"])
    return jax.stages.Compiled(inner.load(), [], (infos, {}), jax.tree.structure([0] * len(results)), no_kwargs=False)


def _type(aval: Any) -> list:
    if type(aval) is not jax.core.ShapedArray:
        raise TypeError(f"cannot serialise a program with arguments of {type(aval)}; compile it in each process")
    kind = np.dtype(aval.dtype)
    if np.dtype(kind.str) != kind:
        raise TypeError(f"cannot serialise a program with arrays of type {kind}; compile it in each process")
    return [list(aval.shape), kind.str, bool(aval.weak_type)]


def _aval(text: list) -> Any:
    shape, kind, weak = text
    return jax.core.ShapedArray(tuple(shape), np.dtype(kind), weak_type=weak)


def _sharding(sharding: Any) -> dict[str, Any]:
    """Describe the placement of an array in JSON."""
    if sharding.memory_kind != "device":
        kind = sharding.memory_kind
        raise TypeError(f"cannot serialise a program with arrays in memory of kind {kind}; compile it in each process")
    if isinstance(sharding, SingleDeviceSharding):
        (device,) = cast(Any, sharding.device_set)
        return {"device": device.id}
    if isinstance(sharding, GSPMDSharding):
        cut, devices = sharding._hlo_sharding.to_proto().SerializeToString(), cast(Any, sharding._device_assignment)
        return {"devices": [device.id for device in devices], "cut": base64.b64encode(cut).decode()}
    if type(sharding) is not NamedSharding or not all(
        part is None or isinstance(part, str) or (type(part) is tuple and all(isinstance(n, str) for n in part))
        for part in sharding.spec
    ):
        raise TypeError(f"cannot serialise a program with arrays of sharding {sharding}; compile it in each process")
    mesh = sharding.mesh
    return {
        "devices": [device.id for device in np.asarray(mesh.devices, object).ravel()],
        "shape": list(mesh.devices.shape),
        "axes": list(mesh.axis_names),
        "types": [kind.name for kind in mesh.axis_types],
        "spec": list(sharding.spec),
    }


def _sharding_of(text: dict[str, Any], by_id: dict[int, Any]) -> Any:
    if "device" in text:
        return SingleDeviceSharding(by_id[text["device"]], memory_kind="device")
    devices = tuple(by_id[number] for number in text["devices"])
    if "cut" in text:
        cut = xla_client.OpSharding()
        cut.ParseFromString(base64.b64decode(text["cut"]))
        return GSPMDSharding(devices, cut, memory_kind="device")
    grid = np.array(devices, object).reshape(text["shape"])
    mesh = Mesh(grid, tuple(text["axes"]), axis_types=tuple(AxisType[name] for name in text["types"]))
    spec = PartitionSpec(*(tuple(part) if isinstance(part, list) else part for part in text["spec"]))
    return NamedSharding(mesh, spec, memory_kind="device")
