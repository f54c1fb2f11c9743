// A peer on ROS 2's wire that uses Fast DDS: sends JointState, counts the Odometry that it gets, on loopback.
//
//     peer DOMAIN COUNT RATE_HZ SECONDS
//
// Types, names and quality of service are those of ROS 2; transports those of its ROS_LOCALHOST_ONLY.

#include <fastcdr/Cdr.h>
#include <fastcdr/FastBuffer.h>
#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/DataReaderListener.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>

#include <array>
#include <atomic>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <memory>
#include <mutex>
#include <set>
#include <string>
#include <thread>
#include <vector>

using namespace eprosima::fastdds::dds;
using eprosima::fastcdr::Cdr;
using eprosima::fastrtps::rtps::InstanceHandle_t;
using eprosima::fastrtps::rtps::SerializedPayload_t;

struct Header {
    int32_t sec = 0;
    uint32_t nanosec = 0;
    std::string frame_id;
};

struct JointState {
    Header header;
    std::vector<std::string> name;
    std::vector<double> position, velocity, effort;
};

struct Odometry {
    Header header;
    std::string child_frame_id;
    std::array<double, 7> pose{};
    std::array<double, 36> pose_covariance{};
    std::array<double, 6> twist{};
    std::array<double, 36> twist_covariance{};
};

void write(Cdr& cdr, const JointState& m) {
    cdr << m.header.sec << m.header.nanosec << m.header.frame_id << m.name << m.position << m.velocity << m.effort;
}
void read(Cdr& cdr, JointState& m) {
    cdr >> m.header.sec >> m.header.nanosec >> m.header.frame_id >> m.name >> m.position >> m.velocity >> m.effort;
}
void write(Cdr& cdr, const Odometry& m) {
    cdr << m.header.sec << m.header.nanosec << m.header.frame_id << m.child_frame_id;
    cdr << m.pose << m.pose_covariance << m.twist << m.twist_covariance;
}
void read(Cdr& cdr, Odometry& m) {
    cdr >> m.header.sec >> m.header.nanosec >> m.header.frame_id >> m.child_frame_id;
    cdr >> m.pose >> m.pose_covariance >> m.twist >> m.twist_covariance;
}

template <typename Message>
class Type : public TopicDataType {
public:
    explicit Type(const char* name) {
        setName(name);
        m_typeSize = 4096;
        m_isGetKeyDefined = false;
    }
    bool serialize(void* data, SerializedPayload_t* payload) override {
        eprosima::fastcdr::FastBuffer buffer(reinterpret_cast<char*>(payload->data), payload->max_size);
        Cdr cdr(buffer, Cdr::DEFAULT_ENDIAN, Cdr::DDS_CDR);
        payload->encapsulation = CDR_LE;
        cdr.serialize_encapsulation();
        write(cdr, *static_cast<Message*>(data));
        payload->length = static_cast<uint32_t>(cdr.getSerializedDataLength());
        return true;
    }
    bool deserialize(SerializedPayload_t* payload, void* data) override {
        eprosima::fastcdr::FastBuffer buffer(reinterpret_cast<char*>(payload->data), payload->length);
        Cdr cdr(buffer, Cdr::DEFAULT_ENDIAN, Cdr::DDS_CDR);
        try {
            cdr.read_encapsulation();
            read(cdr, *static_cast<Message*>(data));
        } catch (const eprosima::fastcdr::exception::Exception&) {
            return false;
        }
        return true;
    }
    std::function<uint32_t()> getSerializedSizeProvider(void*) override {
        return [] { return 4096u; };
    }
    void* createData() override { return new Message; }
    void deleteData(void* data) override { delete static_cast<Message*>(data); }
    bool getKey(void*, InstanceHandle_t*, bool) override { return false; }
};

class Counter : public DataReaderListener {
public:
    // A message counts if it is as the other side makes it: its number is in sec, x and the covariance follow from it.
    void on_data_available(DataReader* reader) override {
        Odometry message;
        SampleInfo info;
        while (reader->take_next_sample(&message, &info) == ReturnCode_t::RETCODE_OK) {
            if (!info.valid_data) continue;
            const double x = 0.5 * message.header.sec;
            const bool right = message.header.frame_id == "map" && message.child_frame_id == "base_link" &&
                               message.pose[0] == x && message.pose_covariance[35] == x && message.twist[5] == x;
            std::lock_guard<std::mutex> guard(lock_);
            (right ? numbers_ : wrong_).insert(message.header.sec);
        }
    }
    size_t right() { std::lock_guard<std::mutex> guard(lock_); return numbers_.size(); }
    size_t wrong() { std::lock_guard<std::mutex> guard(lock_); return wrong_.size(); }

private:
    std::mutex lock_;
    std::set<int> numbers_, wrong_;
};

int main(int argc, char** argv) {
    if (argc != 5) return 2;
    const int domain = std::atoi(argv[1]), count = std::atoi(argv[2]);
    const double rate_hz = std::atof(argv[3]), seconds = std::atof(argv[4]);

    DomainParticipantQos qos = PARTICIPANT_QOS_DEFAULT;
    auto udp = std::make_shared<eprosima::fastdds::rtps::UDPv4TransportDescriptor>();
    udp->interfaceWhiteList.push_back("127.0.0.1");
    qos.transport().use_builtin_transports = false;
    qos.transport().user_transports.push_back(udp);
    DomainParticipant* participant = DomainParticipantFactory::get_instance()->create_participant(domain, qos);
    if (participant == nullptr) return 1;

    TypeSupport joints_type(new Type<JointState>("sensor_msgs::msg::dds_::JointState_"));
    TypeSupport odometry_type(new Type<Odometry>("nav_msgs::msg::dds_::Odometry_"));
    joints_type.register_type(participant);
    odometry_type.register_type(participant);
    Topic* joints = participant->create_topic("rt/joint_states", joints_type.get_type_name(), TOPIC_QOS_DEFAULT);
    Topic* odometry = participant->create_topic("rt/fgloc/odometry", odometry_type.get_type_name(), TOPIC_QOS_DEFAULT);

    DataWriterQos writer_qos = DATAWRITER_QOS_DEFAULT;  // reliable, volatile, as rclcpp's default
    writer_qos.history().kind = KEEP_LAST_HISTORY_QOS;
    writer_qos.history().depth = 10;
    DataWriter* writer = participant->create_publisher(PUBLISHER_QOS_DEFAULT)->create_datawriter(joints, writer_qos);
    DataReaderQos reader_qos = DATAREADER_QOS_DEFAULT;
    reader_qos.reliability().kind = RELIABLE_RELIABILITY_QOS;
    reader_qos.history().kind = KEEP_LAST_HISTORY_QOS;
    reader_qos.history().depth = 10;
    Counter counter;
    participant->create_subscriber(SUBSCRIBER_QOS_DEFAULT)->create_datareader(odometry, reader_qos, &counter);

    using Clock = std::chrono::steady_clock;
    const auto end = Clock::now() + std::chrono::duration<double>(seconds);
    PublicationMatchedStatus matched;
    while (writer->get_publication_matched_status(matched) == ReturnCode_t::RETCODE_OK && matched.current_count == 0) {
        if (Clock::now() > end) { std::printf("no reader\n"); return 1; }
        std::this_thread::sleep_for(std::chrono::milliseconds(10));
    }
    auto due = Clock::now();
    for (int k = 0; k < count; ++k) {
        JointState message;
        message.header.sec = k;
        message.header.frame_id = "base_link";
        message.name = {"left", "right"};
        message.position = {0.5 * k, -0.5 * k};
        writer->write(&message);
        due += std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(1.0 / rate_hz));
        std::this_thread::sleep_until(due);
    }
    while (counter.right() < static_cast<size_t>(count) && Clock::now() < end)
        std::this_thread::sleep_for(std::chrono::milliseconds(20));
    std::printf("%zu %zu\n", counter.right(), counter.wrong());
    return 0;
}
