"""Types of ROS messages as DDS describes them to other participants."""

from typing import Any, Final

from cyclonedds.idl import IdlStruct, make_idl_struct, types

from resonator_daemon.exporting.ros2_types import Nodetype, Typestore

# As ROS has them in DDS: `byte` and `char` are octets.
_BASES: Final[dict[str, Any]] = {
    "bool": bool,
    "byte": types.uint8,
    "char": types.uint8,
    **{name: getattr(types, name) for name in ("float32", "float64", "int8", "int16", "int32", "int64")},
    **{name: getattr(types, name) for name in ("uint8", "uint16", "uint32", "uint64")},
}


class DdsTypes:
    """DDS types of the types of ROS, with the names that ROS uses on the network.

    Parameters
    ----------
    store
        Has the definitions.
    """

    def __init__(self, store: Typestore) -> None:
        self._store = store
        self._made: dict[str, type[IdlStruct]] = {}

    def __getitem__(self, kind: str) -> type[IdlStruct]:
        """Return the type of a kind, as `geometry_msgs/msg/WrenchStamped`."""
        if kind not in self._made:
            package, _, name = kind.split("/")
            fields = {field: self._of(what) for field, what in self._store.fielddefs[kind][1]}
            self._made[kind] = make_idl_struct(name, f"{package}.msg.dds_.{name}_", fields)
        return self._made[kind]

    def _of(self, field: Any) -> Any:
        node, what = field
        if node is Nodetype.NAME:
            return self[what]
        if node is Nodetype.BASE:
            name, bound = what
            if name == "string":
                return types.bounded_str[bound] if bound else str
            return _BASES[name]
        element, count = what
        if node is Nodetype.ARRAY:
            return types.array[self._of(element), count]
        return types.sequence[self._of(element), count] if count else types.sequence[self._of(element)]
