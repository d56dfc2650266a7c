// A mirror of a node's map over a Unix socket or TCP, for POSIX. Header only; needs neither libflockmap nor Rust.
//
//   flockmap_mirror::Client client("unix:/run/flockmap/map.sock");  // or "127.0.0.1:7780", "[::1]:7780"
//   while (client.wait(100)) { plan(client.mirror().map()); }
//
// Connects again when the connection breaks, when the node says nothing for 10 s, and when it ends the connection, unless
// `reconnects` is false. No thread is started; a client is for one thread at a time.
#ifndef FLOCKMAP_MIRROR_CLIENT_HPP
#define FLOCKMAP_MIRROR_CLIENT_HPP

#include <fcntl.h>
#include <netdb.h>
#include <poll.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

#include <cerrno>
#include <chrono>
#include <memory>

#include "flockmap_mirror.hpp"

namespace flockmap_mirror {

struct ClientOptions {
    Options mirror;
    bool reconnects = true;
    int receive_buffer_bytes = 0;  // 0: as the system has it. Smaller for a thin link: less stands in line
};

class Client {
public:
    // The address is "unix:PATH" or "HOST:PORT". Nothing is connected before the first `wait`.
    explicit Client(std::string address, ClientOptions options = {})
        : address_(std::move(address)), options_(options), mirror_(options.mirror) {
        if (address_.rfind("unix:", 0) == 0 ? address_.size() == 5 || address_.size() - 5 >= sizeof(sockaddr_un::sun_path)
                                            : address_.rfind(':') == std::string::npos) {
            throw std::invalid_argument("\"" + address_ + "\", expected unix:PATH with at most " +
                                        std::to_string(sizeof(sockaddr_un::sun_path) - 1) + " bytes, or HOST:PORT");
        }
    }
    ~Client() { disconnect(); }
    Client(const Client&) = delete;
    Client& operator=(const Client&) = delete;

    // Waits for bytes of the node for so long at the most, and takes them in; connects where that is due. False: the
    // connection has ended, and this client does not connect again. What was wrong is in `error`.
    bool wait(int timeout_ms) {
        const auto now = Clock::now();
        if (socket_ < 0) {
            if (was_connected_ && !options_.reconnects) {
                return false;
            }
            const auto until_try = std::chrono::duration_cast<std::chrono::milliseconds>(next_try_ - now).count();
            if (until_try > 0) {
                ::poll(nullptr, 0, static_cast<int>(std::min<long long>(until_try + 1, timeout_ms)));
                return true;
            }
            connect();
            if (socket_ < 0) {
                return true;
            }
        }
        pollfd waiting{socket_, POLLIN, 0};
        if (::poll(&waiting, 1, timeout_ms) <= 0) {
            if (Clock::now() - heard_ > std::chrono::seconds(10)) {
                fail("the node said nothing for 10 s");
            }
            return true;
        }
        std::array<std::uint8_t, 65'536> bytes;
        const ssize_t length = recv(socket_, bytes.data(), bytes.size(), MSG_DONTWAIT);
        if (length < 0) {
            if (errno != EAGAIN && errno != EINTR) {
                fail(std::strerror(errno));
            }
            return true;
        }
        heard_ = Clock::now();
        try {
            mirror_.receive(bytes.data(), static_cast<std::size_t>(length));
        } catch (const FeedError& error) {
            fail(error.what());
            return true;
        }
        if (mirror_.has_ended()) {
            fail("the node ended the connection: " + mirror_.end().value_or(""));
        } else if (length == 0) {
            fail("the connection broke");
        } else if (mirror_.node()) {
            pause_ms_ = kPauseMinMs;
        }
        return true;
    }

    const Mirror& mirror() const noexcept { return mirror_; }
    bool is_connected() const noexcept { return socket_ >= 0; }
    // Why there was no connection last; "" if none failed yet.
    const std::string& error() const noexcept { return error_; }

private:
    using Clock = std::chrono::steady_clock;
    static constexpr int kPauseMinMs = 100, kPauseMaxMs = 2'000, kConnectMs = 5'000;

    void connect() {
        int tried = -1;
        if (address_.rfind("unix:", 0) == 0) {
            sockaddr_un at{};
            at.sun_family = AF_UNIX;
            address_.copy(at.sun_path, sizeof at.sun_path - 1, 5);
            tried = open(AF_UNIX, reinterpret_cast<const sockaddr*>(&at), sizeof at);
        } else {
            const auto colon = address_.rfind(':');
            std::string host = address_.substr(0, colon);
            if (host.size() > 2 && host.front() == '[' && host.back() == ']') {
                host = host.substr(1, host.size() - 2);
            }
            addrinfo hints{}, *found = nullptr;
            hints.ai_socktype = SOCK_STREAM;
            if (const int error = getaddrinfo(host.c_str(), address_.substr(colon + 1).c_str(), &hints, &found)) {
                return fail(gai_strerror(error));
            }
            const std::unique_ptr<addrinfo, decltype(&freeaddrinfo)> all(found, freeaddrinfo);
            for (const addrinfo* one = found; one != nullptr && tried < 0; one = one->ai_next) {
                tried = open(one->ai_family, one->ai_addr, one->ai_addrlen);
            }
        }
        if (tried < 0) {
            return fail(address_ + ": " + std::strerror(errno));
        }
        socket_ = tried;
        heard_ = Clock::now();
        const auto hello = mirror_.begin();
        // A fresh connection has room for 35 bytes.
        if (send(socket_, hello.data(), hello.size(), MSG_NOSIGNAL) != static_cast<ssize_t>(hello.size())) {
            return fail(std::string("no hello could be sent: ") + std::strerror(errno));
        }
        was_connected_ = true;
    }

    // A connected socket, or -1 and errno.
    int open(int family, const sockaddr* at, socklen_t length) const {
        const int tried = ::socket(family, SOCK_STREAM, 0);
        if (tried < 0) {
            return -1;
        }
        const int size = options_.receive_buffer_bytes;
        if (size > 0) {
            (void)setsockopt(tried, SOL_SOCKET, SO_RCVBUF, &size, sizeof size);
        }
        (void)fcntl(tried, F_SETFD, FD_CLOEXEC);
        (void)fcntl(tried, F_SETFL, O_NONBLOCK);
        int error = ::connect(tried, at, length) == 0 ? 0 : errno;
        if (error == EINPROGRESS) {
            pollfd waiting{tried, POLLOUT, 0};
            socklen_t error_length = sizeof error;
            if (::poll(&waiting, 1, kConnectMs) != 1) {
                error = ETIMEDOUT;
            } else if (getsockopt(tried, SOL_SOCKET, SO_ERROR, &error, &error_length) != 0) {
                error = errno;
            }
        }
        if (error != 0) {
            close(tried);
            errno = error;
            return -1;
        }
        return tried;
    }

    void fail(const std::string& why) {
        disconnect();
        error_ = why;
        next_try_ = Clock::now() + std::chrono::milliseconds(pause_ms_);
        pause_ms_ = std::min(2 * pause_ms_, kPauseMaxMs);
    }

    void disconnect() {
        if (socket_ >= 0) {
            close(socket_);
            socket_ = -1;
        }
    }

    std::string address_, error_;
    ClientOptions options_;
    Mirror mirror_;
    int socket_ = -1, pause_ms_ = kPauseMinMs;
    bool was_connected_ = false;
    Clock::time_point next_try_{}, heard_{};
};

}  // namespace flockmap_mirror

#endif
