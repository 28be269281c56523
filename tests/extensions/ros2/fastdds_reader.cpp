// A participant of Fast DDS with nothing but ROS's message definitions; writes what it finds and receives as JSON
// lines, like ros2_reader.py. It decodes with Fast CDR and announces no descriptions of types, like rmw_fastrtps.
// Arguments: the bytes of a Gid in ros_discovery_info (16, or 24 as up to Humble), domain, plate.

#include <fastcdr/Cdr.h>
#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/domain/DomainParticipantListener.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/DataReaderListener.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <fastdds/dds/topic/TypeSupport.hpp>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>
#include <fastrtps/utils/IPLocator.h>

#include <unistd.h>

#include <cstdio>
#include <cstdlib>
#include <functional>
#include <mutex>
#include <sstream>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace fast = eprosima::fastdds::dds;
namespace rtps = eprosima::fastrtps::rtps;
using eprosima::fastcdr::Cdr;

static const std::string DISCOVERY = "ros_discovery_info";

using Json = std::string;
using Reader = std::function<Json(Cdr&)>;

static void write_line(const std::string& what, const Json& members) {
  static std::mutex lock;
  std::lock_guard<std::mutex> guard(lock);
  std::printf("{\"what\": \"%s\", %s\n", what.c_str(), members.c_str() + 1);
  std::fflush(stdout);
}

static Json json_text(const std::string& text) {
  std::ostringstream out;
  for (unsigned char c : text) {
    char code[8];
    std::snprintf(code, sizeof code, "\\u%04x", c);
    if (c < ' ' || c == '"' || c == '\\') out << code;
    else out << c;
  }
  return '"' + out.str() + '"';
}

// ROS's definitions.

template <typename T>
static Json number(Cdr& cdr) {
  T value;
  cdr >> value;
  std::ostringstream out;
  out.precision(17);
  out << +value;
  return out.str();
}

static Json boolean(Cdr& cdr) {
  return number<uint8_t>(cdr) == "0" ? "false" : "true";
}

static Json text(Cdr& cdr) {
  std::string value;
  cdr >> value;
  return json_text(value);
}

static Reader array(Reader element, uint32_t count) {
  return [=](Cdr& cdr) {
    Json out = "[";
    for (uint32_t i = 0; i < count; i++) out += (i ? "," : "") + element(cdr);
    return out + "]";
  };
}

static Reader sequence(Reader element) {
  return [=](Cdr& cdr) {
    uint32_t count;
    cdr >> count;
    return array(element, count)(cdr);
  };
}

static Reader structure(std::vector<std::pair<std::string, Reader>> members) {
  return [=](Cdr& cdr) {
    Json out = "{";
    for (const auto& [name, reader] : members) out += (out.size() > 1 ? ", \"" : "\"") + name + "\": " + reader(cdr);
    return out + "}";
  };
}

static const Reader u8 = number<uint8_t>, u32 = number<uint32_t>, f64 = number<double>;
static const Reader header = structure(
    {{"stamp", structure({{"sec", number<int32_t>}, {"nanosec", u32}})}, {"frame_id", text}});
static const Reader vector3 = structure({{"x", f64}, {"y", f64}, {"z", f64}});
static const Reader wrench_stamped = structure(
    {{"header", header}, {"wrench", structure({{"force", vector3}, {"torque", vector3}})}});
static const Reader field = structure({{"name", text}, {"offset", u32}, {"datatype", u8}, {"count", u32}});
static const Reader cloud = structure(
    {{"header", header}, {"height", u32}, {"width", u32}, {"fields", sequence(field)}, {"is_bigendian", boolean},
     {"point_step", u32}, {"row_step", u32}, {"data", sequence(u8)}, {"is_dense", boolean}});
static const Reader status = structure(
    {{"level", u8}, {"name", text}, {"message", text}, {"hardware_id", text},
     {"values", sequence(structure({{"key", text}, {"value", text}}))}});
static const Reader diagnostics = structure({{"header", header}, {"status", sequence(status)}});

static Reader entities_info(uint32_t gid_bytes) {
  Reader gid = structure({{"data", array(u8, gid_bytes)}});
  Reader node = structure({{"node_namespace", text}, {"node_name", text},
                           {"reader_gid_seq", sequence(gid)}, {"writer_gid_seq", sequence(gid)}});
  return structure({{"gid", gid}, {"node_entities_info_seq", sequence(node)}});
}

// A sample is its JSON.
class RosType : public fast::TopicDataType {
 public:
  RosType(const std::string& name, Reader reader) : reader_(std::move(reader)) {
    setName(name.c_str());
    m_typeSize = 4;  // the readers' histories grow
    auto_fill_type_object(false);
    auto_fill_type_information(false);
  }

  bool deserialize(rtps::SerializedPayload_t* payload, void* sample) override {
    try {
      eprosima::fastcdr::FastBuffer buffer(reinterpret_cast<char*>(payload->data), payload->length);
      Cdr cdr(buffer, Cdr::DEFAULT_ENDIAN, Cdr::DDS_CDR);
      cdr.read_encapsulation();
      *static_cast<Json*>(sample) = reader_(cdr);
      size_t left = payload->length - cdr.getSerializedDataLength();
      if (left > 3) throw std::runtime_error(std::to_string(left) + " bytes too many");
    } catch (const std::exception& error) {
      *static_cast<Json*>(sample) = "{\"error\": " + json_text(error.what()) + "}";
    }
    return true;
  }

  bool serialize(void*, rtps::SerializedPayload_t*) override { return false; }
  std::function<uint32_t()> getSerializedSizeProvider(void*) override { return [] { return 0u; }; }
  bool getKey(void*, rtps::InstanceHandle_t*, bool) override { return false; }
  void* createData() override { return new Json; }
  void deleteData(void* sample) override { delete static_cast<Json*>(sample); }

 private:
  Reader reader_;
};

class Samples : public fast::DataReaderListener {
  void on_data_available(fast::DataReader* reader) override {
    Json sample;
    fast::SampleInfo info;
    while (reader->take_next_sample(&sample, &info) == ReturnCode_t::RETCODE_OK)
      if (info.valid_data) write_line(reader->get_topicdescription()->get_name(), sample);
  }
};

class Discovery : public fast::DomainParticipantListener {
  template <typename Octets>
  static Json members(const rtps::GUID_t& guid, bool alive, const Octets& user_data) {
    std::string key;
    char hex[3];
    for (size_t i = 0; i < 16; i++) {
      std::snprintf(hex, sizeof hex, "%02x", i < 12 ? guid.guidPrefix.value[i] : guid.entityId.value[i - 12]);
      key += hex;
    }
    return "{\"key\": \"" + key + "\", \"alive\": " + (alive ? "true" : "false") +
           ", \"user_data\": " + json_text(std::string(user_data.begin(), user_data.end()));
  }

  void on_participant_discovery(fast::DomainParticipant*, rtps::ParticipantDiscoveryInfo&& found) override {
    bool alive = found.status < rtps::ParticipantDiscoveryInfo::REMOVED_PARTICIPANT;
    write_line("participant", members(found.info.m_guid, alive, found.info.m_userData) + "}");
  }

  void on_publisher_discovery(fast::DomainParticipant*, rtps::WriterDiscoveryInfo&& found) override {
    bool alive = found.status != rtps::WriterDiscoveryInfo::REMOVED_WRITER;
    write_line("publication", members(found.info.guid(), alive, found.info.m_qos.m_userData) +
                                  ", \"topic_name\": " + json_text(found.info.topicName().to_string()) +
                                  ", \"type_name\": " + json_text(found.info.typeName().to_string()) + "}");
  }
};

int main(int, char** arguments) {
  const uint32_t gid_bytes = std::atoi(arguments[1]), domain = std::atoi(arguments[2]);
  const std::string plate = arguments[3];
  fast::DomainParticipantQos qos;
  auto loopback = std::make_shared<eprosima::fastdds::rtps::UDPv4TransportDescriptor>();
  loopback->interfaceWhiteList = {"127.0.0.1"};
  qos.transport().use_builtin_transports = false;
  qos.transport().user_transports.push_back(loopback);
  rtps::Locator_t peer;  // of any port: multicast need not work
  rtps::IPLocator::setIPv4(peer, "127.0.0.1");
  qos.wire_protocol().builtin.initialPeersList.push_back(peer);
  Discovery discovery;
  fast::DomainParticipant* participant = fast::DomainParticipantFactory::get_instance()->create_participant(
      domain, qos, &discovery, fast::StatusMask::none());
  if (participant == nullptr) return 1;
  fast::Subscriber* subscriber = participant->create_subscriber(fast::SUBSCRIBER_QOS_DEFAULT);
  Samples samples;
  auto subscribe = [&](const std::string& name, const std::string& kind, const Reader& reader, bool reliable) {
    fast::TypeSupport type(new RosType(kind, reader));
    type.register_type(participant);
    fast::DataReaderQos reader_qos;
    reader_qos.reliability().kind = reliable ? fast::RELIABLE_RELIABILITY_QOS : fast::BEST_EFFORT_RELIABILITY_QOS;
    if (name == DISCOVERY) reader_qos.durability().kind = fast::TRANSIENT_LOCAL_DURABILITY_QOS;
    reader_qos.history().depth = 10;
    reader_qos.endpoint().history_memory_policy = rtps::PREALLOCATED_WITH_REALLOC_MEMORY_MODE;
    fast::Topic* topic = participant->create_topic(name, kind, fast::TOPIC_QOS_DEFAULT);
    subscriber->create_datareader(topic, reader_qos, &samples);
  };
  const std::string wrench_kind = "geometry_msgs::msg::dds_::WrenchStamped_";
  subscribe("rt/" + plate + "/wrench", wrench_kind, wrench_stamped, true);
  subscribe("rt/" + plate + "/contacts/wrench", wrench_kind, wrench_stamped, false);
  subscribe("rt/" + plate + "/decoded/cloud", "sensor_msgs::msg::dds_::PointCloud2_", cloud, true);
  subscribe("rt/diagnostics", "diagnostic_msgs::msg::dds_::DiagnosticArray_", diagnostics, true);
  subscribe(DISCOVERY, "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_", entities_info(gid_bytes), true);
  for (;;) pause();
}
