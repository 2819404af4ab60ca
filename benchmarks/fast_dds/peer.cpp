// A participant by Fast DDS, with the quality of service that rmw_fastrtps sets. It publishes the bytes
// of a message from a file, or writes those that arrive to one.
//
//     peer pub|sub TOPIC TYPE reliable|best latched|volatile HZ SECONDS FILE
#include <chrono>
#include <cstring>
#include <fstream>
#include <functional>
#include <iostream>
#include <iterator>
#include <thread>
#include <vector>

#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <fastdds/dds/topic/TypeSupport.hpp>

using namespace eprosima::fastdds::dds;
using eprosima::fastrtps::rtps::InstanceHandle_t;
using eprosima::fastrtps::rtps::SerializedPayload_t;
using Bytes = std::vector<unsigned char>;

class Raw : public TopicDataType {
 public:
  explicit Raw(const std::string& name) {
    setName(name.c_str());
    m_typeSize = 4 * 1024 * 1024 + 4;
    m_isGetKeyDefined = false;
    auto_fill_type_information(false);
    auto_fill_type_object(false);
  }
  bool serialize(void* data, SerializedPayload_t* payload) override {
    const auto& bytes = *static_cast<Bytes*>(data);
    std::memcpy(payload->data, bytes.data(), bytes.size());
    payload->length = bytes.size();
    payload->encapsulation = CDR_LE;
    return true;
  }
  bool deserialize(SerializedPayload_t* payload, void* data) override {
    static_cast<Bytes*>(data)->assign(payload->data, payload->data + payload->length);
    return true;
  }
  std::function<uint32_t()> getSerializedSizeProvider(void* data) override {
    return [data] { return static_cast<uint32_t>(static_cast<Bytes*>(data)->size()); };
  }
  void* createData() override { return new Bytes; }
  void deleteData(void* data) override { delete static_cast<Bytes*>(data); }
  bool getKey(void*, InstanceHandle_t*, bool) override { return false; }
};

int main(int, char** words) {
  const std::string mode = words[1];
  const bool reliable = std::string(words[4]) == "reliable";
  const bool latched = std::string(words[5]) == "latched";
  const double hz = std::stod(words[6]);
  const double seconds = std::stod(words[7]);
  const char* domain = std::getenv("ROS_DOMAIN_ID");
  auto* participant = DomainParticipantFactory::get_instance()->create_participant(
      domain ? std::atoi(domain) : 0, PARTICIPANT_QOS_DEFAULT);
  TypeSupport type(new Raw(words[3]));
  type.register_type(participant);
  auto* topic = participant->create_topic(words[2], words[3], TOPIC_QOS_DEFAULT);
  const auto reliability = reliable ? RELIABLE_RELIABILITY_QOS : BEST_EFFORT_RELIABILITY_QOS;
  const auto durability = latched ? TRANSIENT_LOCAL_DURABILITY_QOS : VOLATILE_DURABILITY_QOS;
  const auto end = std::chrono::steady_clock::now() + std::chrono::duration<double>(seconds);
  long number = 0;
  if (mode == "pub") {
    std::ifstream file(words[8], std::ios::binary);
    Bytes bytes((std::istreambuf_iterator<char>(file)), {});
    DataWriterQos qos = DATAWRITER_QOS_DEFAULT;
    qos.reliability().kind = reliability;
    qos.durability().kind = durability;
    qos.history().kind = KEEP_LAST_HISTORY_QOS;
    qos.history().depth = latched ? 1 : 5;
    qos.publish_mode().kind = ASYNCHRONOUS_PUBLISH_MODE;
    qos.endpoint().history_memory_policy =
        eprosima::fastrtps::rtps::PREALLOCATED_WITH_REALLOC_MEMORY_MODE;
    qos.data_sharing().off();
    auto* writer = participant->create_publisher(PUBLISHER_QOS_DEFAULT)->create_datawriter(topic, qos);
    while (std::chrono::steady_clock::now() < end) {
      if (!latched || number == 0) {
        writer->write(&bytes);
        number++;
      }
      std::this_thread::sleep_for(std::chrono::duration<double>(1 / hz));
    }
    std::cout << "sent " << number << std::endl;
    return 0;
  }
  DataReaderQos qos = DATAREADER_QOS_DEFAULT;
  qos.reliability().kind = reliability;
  qos.durability().kind = durability;
  qos.history().depth = 10;
  qos.endpoint().history_memory_policy =
      eprosima::fastrtps::rtps::PREALLOCATED_WITH_REALLOC_MEMORY_MODE;
  auto* reader = participant->create_subscriber(SUBSCRIBER_QOS_DEFAULT)->create_datareader(topic, qos);
  Bytes bytes;
  SampleInfo info;
  while (std::chrono::steady_clock::now() < end) {
    if (!reader->wait_for_unread_message({0, 100000000})) continue;
    while (reader->take_next_sample(&bytes, &info) == ReturnCode_t::RETCODE_OK)
      if (info.valid_data) {
        number++;
        std::ofstream(words[8], std::ios::binary).write(reinterpret_cast<char*>(bytes.data()), bytes.size());
      }
  }
  std::cout << "received " << number << std::endl;
}
