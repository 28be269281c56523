"""A node of ROS 2 made of DDS alone: a participant, its writers, and what makes ROS list them.

ROS finds topics in the discovery of DDS itself, by names that begin with `rt/` and types that end in `_`. The type hash
in the user data of a writer is optional; without it, newer versions of ROS log a warning. Names of nodes come from the
topic `ros_discovery_info` and from the user data of the participant.
"""

import os
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any, Final

import numpy as np

from resonator_daemon.base.errors import ExitCode, MissingLibraryError, UserError
from resonator_daemon.base.host.text import how_to_install

try:
    from cyclonedds.core import DDSException
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.idl import IdlStruct, make_idl_struct, types
    from cyclonedds.pub import DataWriter
    from cyclonedds.qos import Policy, Qos
    from cyclonedds.topic import Topic
    from rosbags.interfaces import Nodetype
    from rosbags.typesys.store import Typestore
except ImportError as error:
    needed = "cyclonedds rosbags"
    raise MissingLibraryError(f"the bridge to ROS 2 needs {needed}: {how_to_install(needed)}") from error


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


NODE: Final = "resonatord"
DEPTH: Final = 10  # messages that a slow reader finds; older ones are replaced

_DISCOVERY: Final = "ros_discovery_info"
_DISCOVERY_KIND: Final = "rmw_dds_common/msg/ParticipantEntitiesInfo"
_GID: Final = "rmw_dds_common/msg/Gid"
# Of a writer that is removed, Cyclone DDS sends the GUID as a payload. Fast DDS reads it from the key hash alone, and
# without that continues to list the writer.
_KEY_HASHES: Final = (
    "<CycloneDDS><Domain><Internal><GenerateKeyhash>true</GenerateKeyhash></Internal></Domain></CycloneDDS>"
)
# A writer never waits: if a reader is behind, it misses messages.
_RELIABLE: Final = Policy.Reliability.Reliable(max_blocking_time=0)


class DomainError(UserError):
    """The DDS domain cannot be joined."""

    exit_code = ExitCode.UNAVAILABLE
    code = "dds"


class Ros2Node:
    """Node that publishes messages in CDR to all subscribers of ROS 2 in a domain, until `close`.

    Parameters
    ----------
    domain_id
        As ROS_DOMAIN_ID.
    namespace
        Of the node: empty, or as `/hand`.
    store
        Definitions of the messages.

    Attributes
    ----------
    dropped : Counter
        Messages that were not written, by topic: readers were too far behind.

    Raises
    ------
    UserError
        The domain cannot be joined.
    """

    def __init__(self, domain_id: int, namespace: str, store: Typestore) -> None:
        self.dropped: Counter[str] = Counter()
        self._namespace = namespace or "/"
        self._store = store
        self._types = DdsTypes(store)
        self._writers: dict[str, DataWriter[Any]] = {}
        os.environ["CYCLONEDDS_URI"] = ",".join(filter(None, (_KEY_HASHES, os.environ.get("CYCLONEDDS_URI"))))
        try:
            self._participant = DomainParticipant(domain_id, Qos(Policy.Userdata(b"enclave=/;")))
            durability = (Policy.Durability.TransientLocal, Policy.History.KeepLast(1))
            self._discovery = self._make_writer(_DISCOVERY, _DISCOVERY_KIND, *durability)
        except DDSException as error:
            raise DomainError(f"DDS domain {domain_id} cannot be joined: {error.msg}; see CYCLONEDDS_URI") from None
        self._announce()

    def advertise(self, topics: Mapping[str, str]) -> None:
        """Announce topics, for example `/left_index/wrench`, with their types; those announced before stay."""
        new = {topic: kind for topic, kind in topics.items() if topic not in self._writers}
        for topic, kind in new.items():
            durability = (Policy.Durability.Volatile, Policy.History.KeepLast(DEPTH))
            self._writers[topic] = self._make_writer(f"rt{topic}", kind, *durability)
        if new:
            self._announce()

    def withdraw(self, topics: Iterable[str]) -> None:
        """Remove advertised topics."""
        for topic in topics:
            del self._writers[topic]
        self._announce()

    def has_readers(self, topic: str) -> bool:
        """Return whether an advertised topic has a subscriber."""
        return topic in self._writers and bool(self._writers[topic].get_matched_subscriptions())

    def write(self, topic: str, data: bytes) -> None:
        """Send a message in CDR; dropped where a reader is too far behind."""
        try:
            _write(self._writers[topic], data)
        except DDSException as error:
            if error.code != DDSException.DDS_RETCODE_TIMEOUT:
                raise
            self.dropped[topic] += 1

    def close(self) -> None:
        """Leave the domain."""
        self._writers.clear()
        del self._discovery, self._participant

    def _make_writer(self, name: str, kind: str, *policies: Any) -> DataWriter[Any]:
        user_data = Policy.Userdata(f"typehash={self._store.hash_rihs01(kind)};".encode())
        topic = Topic(self._participant, name, self._types[kind])
        return DataWriter(self._participant, topic, Qos(_RELIABLE, user_data, *policies))

    def _announce(self) -> None:
        """Publish the node and its writers, so that ROS lists them."""
        types = self._store.types
        octets: Any = dict(self._store.fielddefs[_GID][1])["data"][1]
        gid_bytes = octets[1]  # 16, up to Humble 24

        def gid_of(entity: Any) -> Any:
            return types[_GID](data=np.frombuffer(entity.guid.bytes.ljust(gid_bytes, b"\0"), np.uint8))

        node = types["rmw_dds_common/msg/NodeEntitiesInfo"](
            node_namespace=self._namespace,
            node_name=NODE,
            reader_gid_seq=[],
            writer_gid_seq=[gid_of(writer) for writer in self._writers.values()],
        )
        message = types[_DISCOVERY_KIND](gid=gid_of(self._participant), node_entities_info_seq=[node])
        _write(self._discovery, bytes(self._store.serialize_cdr(message, _DISCOVERY_KIND)))


def _write(writer: DataWriter[Any], data: bytes) -> None:
    """Write bytes that are encoded already."""
    sample: Any = object.__new__(writer.data_type)
    sample.serialize = lambda **_: data
    writer.write(sample)
