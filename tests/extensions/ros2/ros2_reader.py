"""A participant of DDS with nothing but ROS's message definitions; writes what it finds and receives as JSON lines."""

import dataclasses
import json
import sys
from typing import Any

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsParticipant, BuiltinTopicDcpsPublication
from cyclonedds.core import InstanceState, Policy, Qos, ReadCondition, SampleState, WaitSet
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import make_idl_struct
from cyclonedds.idl.types import array, bounded_str, float64, int32, sequence, uint8, uint32
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic


def ros(kind: str, **fields: Any) -> Any:
    package, name = kind.split("/")
    return make_idl_struct(name, f"{package}.msg.dds_.{name}_", fields)


TIME = ros("builtin_interfaces/Time", sec=int32, nanosec=uint32)
HEADER = ros("std_msgs/Header", stamp=TIME, frame_id=str)
VECTOR = ros("geometry_msgs/Vector3", x=float64, y=float64, z=float64)
WRENCH = ros("geometry_msgs/Wrench", force=VECTOR, torque=VECTOR)
WRENCH_STAMPED = ros("geometry_msgs/WrenchStamped", header=HEADER, wrench=WRENCH)
FIELD = ros("sensor_msgs/PointField", name=str, offset=uint32, datatype=uint8, count=uint32)
CLOUD = ros(
    "sensor_msgs/PointCloud2",
    **{"header": HEADER, "height": uint32, "width": uint32, "fields": sequence[FIELD], "is_bigendian": bool},
    **{"point_step": uint32, "row_step": uint32, "data": sequence[uint8], "is_dense": bool},
)
KEY = ros("diagnostic_msgs/KeyValue", key=str, value=str)
STATUS = ros(
    "diagnostic_msgs/DiagnosticStatus", level=uint8, name=str, message=str, hardware_id=str, values=sequence[KEY]
)
DIAGNOSTICS = ros("diagnostic_msgs/DiagnosticArray", header=HEADER, status=sequence[STATUS])
GID = ros("rmw_dds_common/Gid", data=array[uint8, 16])
NODE = ros(
    "rmw_dds_common/NodeEntitiesInfo",
    **{"node_namespace": bounded_str[256], "node_name": bounded_str[256]},
    **{"reader_gid_seq": sequence[GID], "writer_gid_seq": sequence[GID]},
)
PARTICIPANT = ros("rmw_dds_common/ParticipantEntitiesInfo", gid=GID, node_entities_info_seq=sequence[NODE])


def main(domain_id: int, plate: str) -> None:
    participant = DomainParticipant(domain_id)
    reliable = Policy.Reliability.Reliable(0)
    readers = {
        topic: DataReader(participant, Topic(participant, topic, kind), Qos(*policies))
        for topic, kind, *policies in (
            (f"rt/{plate}/wrench", WRENCH_STAMPED, reliable),  # as ROS subscribes by default
            (f"rt/{plate}/contacts/wrench", WRENCH_STAMPED, Policy.Reliability.BestEffort),  # as to sensors' data
            (f"rt/{plate}/decoded/cloud", CLOUD, reliable),
            ("rt/diagnostics", DIAGNOSTICS, reliable),
            ("ros_discovery_info", PARTICIPANT, reliable, Policy.Durability.TransientLocal),
        )
    }
    for name, topic in (("participant", BuiltinTopicDcpsParticipant), ("publication", BuiltinTopicDcpsPublication)):
        readers[name] = BuiltinDataReader(participant, topic)
    waiting = WaitSet(participant)
    conditions = [ReadCondition(reader, SampleState.NotRead) for reader in readers.values()]
    for condition in conditions:
        waiting.attach(condition)
    while True:
        waiting.wait(10**9)
        for what, reader in readers.items():
            for one in reader.take(100):
                if what in ("participant", "publication"):
                    alive = one.sample_info.instance_state == InstanceState.Alive
                    data = one.qos[Policy.Userdata] if alive and one.qos else None
                    names = {name: getattr(one, name, None) for name in ("topic_name", "type_name")}
                    write(what, key=one.key.hex, alive=alive, user_data=data and data.data.decode(), **names)
                elif dataclasses.is_dataclass(one):  # else the end of a writer
                    write(what, **dataclasses.asdict(one))


def write(what: str, **fields: Any) -> None:
    sys.stdout.write(json.dumps({"what": what, **fields}, default=list) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2])
