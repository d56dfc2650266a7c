// Two robots over UDP, of which every fifth datagram is lost: each has a thread, a socket and a clock of its own.
//
// On two computers `fly` is the same; only that there is no `Board` that says when both are done.
#include <arpa/inet.h>
#include <poll.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <map>
#include <mutex>
#include <random>
#include <thread>

#include "flockmap.hpp"

namespace {

constexpr int kScans = 20;
constexpr std::int64_t kScanUs = 100'000;  // a scan every tenth of a second
constexpr std::int64_t kPatienceUs = 120'000'000;
constexpr double kLoss = 0.2;

// A UDP socket of this machine, at a port that the system chooses.
class Socket {
public:
    Socket() : socket_(socket(AF_INET, SOCK_DGRAM, 0)) {
        address_.sin_family = AF_INET;
        address_.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
        socklen_t length = sizeof address_;
        if (socket_ < 0 || bind(socket_, reinterpret_cast<sockaddr*>(&address_), length) != 0 ||
            getsockname(socket_, reinterpret_cast<sockaddr*>(&address_), &length) != 0) {
            throw std::runtime_error("no UDP socket");
        }
    }
    ~Socket() { close(socket_); }
    Socket(const Socket&) = delete;
    Socket& operator=(const Socket&) = delete;

    const sockaddr_in& address() const { return address_; }

    void send(const std::vector<std::uint8_t>& bytes, const sockaddr_in& to) const {
        // What does not go out is lost, and repaired as everything that is lost.
        (void)sendto(socket_, bytes.data(), bytes.size(), 0, reinterpret_cast<const sockaddr*>(&to), sizeof to);
    }

    // Waits for a datagram, but not longer than this. -1: none came.
    ssize_t receive(std::array<std::uint8_t, 2048>& buffer, std::int64_t wait_us) const {
        pollfd waiting{socket_, POLLIN, 0};
        const auto ms = static_cast<int>(std::clamp<std::int64_t>(wait_us / 1000 + 1, 1, 100));
        return poll(&waiting, 1, ms) > 0 ? recv(socket_, buffer.data(), buffer.size(), MSG_DONTWAIT) : -1;
    }

private:
    int socket_;
    sockaddr_in address_{};
};

// What each robot that has mapped all holds: a digest of the layer of each stream.
using Layers = std::map<std::pair<std::uint16_t, std::uint64_t>, std::uint64_t>;
struct Board {
    std::mutex mutex;
    std::map<int, Layers> layers;
};

// Whether both robots have mapped all and hold the same; notes what this one holds.
bool is_agreed(int id, const flockmap::Robot& robot, int scans, Board& board) {
    if (scans < kScans || robot.unpublished() > 0) {
        return false;
    }
    Layers layers;
    for (const auto& layer : robot.layers()) {
        layers[{layer.origin, layer.epoch}] = layer.digest;
    }
    const std::lock_guard<std::mutex> lock(board.mutex);
    board.layers[id] = std::move(layers);
    return board.layers.size() == 2 && board.layers[1] == board.layers[2] && board.layers[1].size() == 2;
}

// A wall on one side of a street, along which the robot flies.
std::vector<float> sense(int id) {
    std::vector<float> points;
    for (int x = -40; x <= 40; ++x) {
        for (int z = -5; z <= 5; ++z) {
            points.insert(points.end(), {x * 0.2f, id == 1 ? 5.0f : -5.0f, z * 0.2f});
        }
    }
    return points;
}

void fly(int id, const Socket& socket, const sockaddr_in& other, Board& board) {
    auto options = flockmap::default_options();
    options.id = static_cast<std::uint16_t>(id);
    options.resolution_m = 0.2;
    options.range_m = 20.0;
    options.publish_period_ms = 100;
    // The robot's clock: microseconds since it began. The others have clocks of their own.
    const auto began = std::chrono::steady_clock::now();
    const auto clock = [began] {
        return std::chrono::duration_cast<std::chrono::microseconds>(std::chrono::steady_clock::now() - began).count();
    };
    flockmap::Robot robot(options, clock());
    std::mt19937 radio(id);
    std::array<std::uint8_t, 2048> buffer;
    int scans = 0;
    std::size_t lost = 0;
    while (!is_agreed(id, robot, scans, board)) {
        // What is due now.
        const std::int64_t now = clock();
        if (scans < kScans && now >= scans * kScanUs) {
            const double x = static_cast<double>(now) / 1e6;
            robot.insert_scan(now, now, sense(id), flockmap::at(x, 0.0, 1.0));
            ++scans;
        }
        if (const auto due = robot.poll_timeout(); due && *due <= now) {
            robot.handle_timeout(now);
        }
        // All that is to be sent. A path is a number that stands for an address: there is only one here.
        while (const auto datagram = robot.poll_transmit(now)) {
            if (!datagram->to.to_everyone && !datagram->to.has_path) {
                continue;  // for a robot that was never heard
            }
            if (std::uniform_real_distribution<>()(radio) < kLoss) {
                ++lost;
            } else {
                socket.send(datagram->bytes, other);
            }
        }
        // Wait for a datagram, but not longer than until the robot or the sensor has something to do.
        const std::int64_t next_scan = scans < kScans ? scans * kScanUs : now + kScanUs;
        const std::int64_t due = std::min(robot.poll_timeout().value_or(next_scan), next_scan);
        const ssize_t length = socket.receive(buffer, due - clock());
        if (length >= 0) {
            // Damaged datagrams and those of strangers are counted, and change nothing.
            robot.handle_datagram_from(clock(), 0, {buffer.data(), static_cast<std::size_t>(length)});
        }
        if (clock() > kPatienceUs) {
            throw std::runtime_error("the robots do not agree after two minutes");
        }
    }
    const auto map = robot.view();
    const auto info = map.info();
    std::printf("robot %d knows %zu free and %zu occupied voxels; %zu of its datagrams were lost\n", id, info.free,
                info.occupied, lost);
    // Each of the two walls was seen by one of them only, and is in both maps.
    for (const double y : {5.05, -4.95}) {
        if (map.state_at({1.05, y, 1.05}) != flockmap::State::Occupied) {
            throw std::runtime_error("a wall is missing");
        }
    }
    if (lost == 0) {
        throw std::runtime_error("the radio lost nothing");
    }
}

}  // namespace

int main() {
    const Socket one, two;
    Board board;
    std::string wrong;
    std::mutex mutex;
    const auto guarded = [&](int id, const Socket& socket, const Socket& other) {
        try {
            fly(id, socket, other.address(), board);
        } catch (const std::exception& error) {
            const std::lock_guard<std::mutex> lock(mutex);
            wrong = error.what();
        }
    };
    std::thread second([&] { guarded(2, two, one); });
    guarded(1, one, two);
    second.join();
    if (!wrong.empty()) {
        std::fprintf(stderr, "%s\n", wrong.c_str());
        return 1;
    }
    std::puts("both robots hold the same layers");
    return 0;
}
