// SPDX-License-Identifier: MIT
#include "ajna/flight/transport.hpp"

#include <fcntl.h>
#include <netdb.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <sys/socket.h>
#include <termios.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstring>
#include <optional>
#include <utility>
#include <vector>

#include "ajna/base/error.hpp"

namespace ajna::flight {
namespace {

constexpr double kReopen_s = 1.0;
/// A UDP peer that has been silent for so long may have come back elsewhere.
constexpr double kForgetPeer_s = 3.0;

std::string system_text(const std::string& what) { return what + ": " + std::strerror(errno); }

/// What all kinds share: one file descriptor, opened anew once a second while it is closed.
class DescriptorTransport : public Transport {
 public:
  ~DescriptorTransport() override { close_now(""); }

  void service(double now_s) noexcept override {
    now_s_ = now_s;
    if (fd_ < 0 && (!tried_s_ || now_s - *tried_s_ >= kReopen_s)) {
      tried_s_ = now_s;
      try {
        open();
      } catch (...) {  // out of memory: the next second tries again
      }
    }
    watch();
  }

  [[nodiscard]] bool is_open() const noexcept override { return fd_ >= 0; }
  [[nodiscard]] int descriptor() const noexcept override { return fd_; }
  [[nodiscard]] std::string problem() const override { return fd_ >= 0 ? "" : problem_; }

 protected:
  virtual void open() = 0;
  virtual void watch() noexcept {}

  void close_now(const std::string& why) {
    if (fd_ >= 0) {
      ::close(fd_);
      fd_ = -1;
    }
    problem_ = why;
  }
  bool make_non_blocking() const { return ::fcntl(fd_, F_SETFL, ::fcntl(fd_, F_GETFL) | O_NONBLOCK) == 0; }
  static bool would_block() { return errno == EAGAIN || errno == EWOULDBLOCK || errno == EINTR; }

  int fd_ = -1;
  double now_s_ = 0.0;

 private:
  std::optional<double> tried_s_;
  std::string problem_ = "not opened yet";
};

/// Resolved once, at construction, so that a name server can never hold up the flight.
struct Address {
  sockaddr_storage storage{};
  socklen_t size = 0;
};

Address resolve(const Endpoint& endpoint, int type, bool passive) {
  addrinfo hints{};
  hints.ai_family = AF_UNSPEC;
  hints.ai_socktype = type;
  hints.ai_flags = passive ? AI_PASSIVE : 0;
  addrinfo* found = nullptr;
  const std::string port = std::to_string(endpoint.port);
  const int failure = ::getaddrinfo(endpoint.host.c_str(), port.c_str(), &hints, &found);
  if (failure != 0 || found == nullptr) {
    throw_invalid("address '" + endpoint.host + ":" + port + "' cannot be resolved (" + ::gai_strerror(failure) +
                  "): give a host name or a numeric address");
  }
  Address address;
  std::memcpy(&address.storage, found->ai_addr, found->ai_addrlen);
  address.size = found->ai_addrlen;
  ::freeaddrinfo(found);
  return address;
}

class UdpTransport final : public DescriptorTransport {
 public:
  UdpTransport(const Endpoint& endpoint, bool listens)
      : listens_(listens), address_(resolve(endpoint, SOCK_DGRAM, listens)) {}

  std::size_t read(std::uint8_t* data, std::size_t size) noexcept override {
    if (fd_ < 0) {
      return 0;
    }
    sockaddr_storage from{};
    socklen_t from_size = sizeof(from);
    const ssize_t count = ::recvfrom(fd_, data, size, 0, reinterpret_cast<sockaddr*>(&from), &from_size);
    if (count <= 0) {
      return 0;
    }
    heard_s_ = now_s_;
    if (listens_ && !has_peer_) {
      // From now on only this peer is heard, and written to.
      has_peer_ = ::connect(fd_, reinterpret_cast<const sockaddr*>(&from), from_size) == 0;
    }
    return static_cast<std::size_t>(count);
  }

  bool write(const std::uint8_t* data, std::size_t size) noexcept override {
    if (fd_ < 0 || !has_peer_) {
      return false;
    }
    const ssize_t count = ::send(fd_, data, size, MSG_NOSIGNAL);
    // "Refused" is an answer to an earlier datagram: nobody listens there yet. The next one may arrive.
    return count == static_cast<ssize_t>(size) || (count < 0 && errno == ECONNREFUSED);
  }

  [[nodiscard]] int descriptor() const noexcept override { return has_peer_ ? fd_ : -1; }

 protected:
  void open() override {
    fd_ = ::socket(address_.storage.ss_family, SOCK_DGRAM | SOCK_CLOEXEC, 0);
    has_peer_ = false;
    heard_s_.reset();
    const auto* address = reinterpret_cast<const sockaddr*>(&address_.storage);
    if (fd_ < 0 || !make_non_blocking() ||
        (listens_ ? ::bind(fd_, address, address_.size) : ::connect(fd_, address, address_.size)) != 0) {
      close_now(system_text("UDP socket"));
      return;
    }
    has_peer_ = !listens_;
  }

  void watch() noexcept override {
    if (listens_ && has_peer_ && heard_s_ && now_s_ - *heard_s_ > kForgetPeer_s) {
      sockaddr unspecified{};
      unspecified.sa_family = AF_UNSPEC;
      ::connect(fd_, &unspecified, sizeof(unspecified));
      has_peer_ = false;
    }
  }

 private:
  bool listens_;
  Address address_;
  bool has_peer_ = false;
  std::optional<double> heard_s_;
};

/// Streams of bytes, where a write may be taken in part: the rest of that frame goes first, nothing else is kept.
class StreamTransport : public DescriptorTransport {
 public:
  std::size_t read(std::uint8_t* data, std::size_t size) noexcept override {
    if (fd_ < 0 || connecting_) {
      return 0;
    }
    const ssize_t count = ::read(fd_, data, size);
    if (count > 0) {
      return static_cast<std::size_t>(count);
    }
    if ((count == 0 && ends_) || (count < 0 && !would_block())) {
      close_now(count == 0 ? "closed by the other side" : system_text("read"));
    }
    return 0;
  }

  bool write(const std::uint8_t* data, std::size_t size) noexcept override {
    if (fd_ < 0 || connecting_ || !finish()) {
      return false;
    }
    const ssize_t count = put(data, size);
    if (count == static_cast<ssize_t>(size)) {
      return true;
    }
    if (count < 0) {
      if (!would_block()) {
        close_now(system_text("write"));
      }
      return false;
    }
    try {
      rest_.assign(data + count, data + size);
      return true;
    } catch (...) {  // a message cut in half must not be followed by another
      close_now("out of memory");
      return false;
    }
  }

  [[nodiscard]] bool is_open() const noexcept override { return fd_ >= 0 && !connecting_; }
  [[nodiscard]] int descriptor() const noexcept override { return connecting_ ? -1 : fd_; }

 protected:
  explicit StreamTransport(bool ends) : ends_(ends) {}
  virtual ssize_t put(const std::uint8_t* data, std::size_t size) noexcept = 0;
  void begin(bool connecting) {
    rest_.clear();
    connecting_ = connecting;
  }
  bool connecting_ = false;

 private:
  bool finish() noexcept {
    if (rest_.empty()) {
      return true;
    }
    const ssize_t count = put(rest_.data(), rest_.size());
    if (count < 0 && !would_block()) {
      close_now(system_text("write"));
      return false;
    }
    rest_.erase(rest_.begin(), rest_.begin() + std::max<ssize_t>(count, 0));
    return rest_.empty();
  }

  bool ends_;  ///< whether reading nothing means the end
  std::vector<std::uint8_t> rest_;
};

class TcpTransport final : public StreamTransport {
 public:
  explicit TcpTransport(const Endpoint& endpoint)
      : StreamTransport(true), address_(resolve(endpoint, SOCK_STREAM, false)) {}

 protected:
  ssize_t put(const std::uint8_t* data, std::size_t size) noexcept override {
    return ::send(fd_, data, size, MSG_NOSIGNAL);
  }

  void open() override {
    fd_ = ::socket(address_.storage.ss_family, SOCK_STREAM | SOCK_CLOEXEC, 0);
    if (fd_ < 0 || !make_non_blocking()) {
      close_now(system_text("TCP socket"));
      return;
    }
    const int on = 1;
    ::setsockopt(fd_, IPPROTO_TCP, TCP_NODELAY, &on, sizeof(on));
    const int result = ::connect(fd_, reinterpret_cast<const sockaddr*>(&address_.storage), address_.size);
    if (result != 0 && errno != EINPROGRESS) {
      close_now(system_text("TCP connection"));
      return;
    }
    began_s_ = now_s_;
    begin(result != 0);
  }

  void watch() noexcept override {
    if (fd_ < 0 || !connecting_) {
      return;
    }
    pollfd waiting{fd_, POLLOUT, 0};
    if (::poll(&waiting, 1, 0) > 0) {
      int failure = 0;
      socklen_t size = sizeof(failure);
      ::getsockopt(fd_, SOL_SOCKET, SO_ERROR, &failure, &size);
      if (failure != 0) {
        errno = failure;
        close_now(system_text("TCP connection"));
      }
      connecting_ = false;
    } else if (now_s_ - began_s_ > kForgetPeer_s) {
      close_now("TCP connection: no answer");
      connecting_ = false;
    }
  }

 private:
  Address address_;
  double began_s_ = 0.0;
};

class SerialTransport final : public StreamTransport {
 public:
  explicit SerialTransport(Endpoint endpoint) : StreamTransport(false), endpoint_(std::move(endpoint)) {}

 protected:
  ssize_t put(const std::uint8_t* data, std::size_t size) noexcept override { return ::write(fd_, data, size); }

  void open() override {
    fd_ = ::open(endpoint_.device.c_str(), O_RDWR | O_NOCTTY | O_NONBLOCK | O_CLOEXEC);
    termios settings{};
    if (fd_ < 0 || ::tcgetattr(fd_, &settings) != 0) {
      close_now(system_text("serial port '" + endpoint_.device + "'"));
      return;
    }
    ::cfmakeraw(&settings);
    settings.c_cflag |= CLOCAL | CREAD;
    settings.c_cflag &= ~static_cast<tcflag_t>(CSTOPB | CRTSCTS);
    settings.c_cc[VMIN] = 0;
    settings.c_cc[VTIME] = 0;
    ::cfsetspeed(&settings, static_cast<speed_t>(endpoint_.speed));
    if (::tcsetattr(fd_, TCSANOW, &settings) != 0) {
      close_now(system_text("serial port '" + endpoint_.device + "'"));
      return;
    }
    ::tcflush(fd_, TCIOFLUSH);
    begin(false);
  }

 private:
  Endpoint endpoint_;
};

}  // namespace

std::unique_ptr<Transport> make_transport(const Endpoint& endpoint) {
  switch (endpoint.kind) {
    case Endpoint::Kind::kUdpListen:
      return std::make_unique<UdpTransport>(endpoint, true);
    case Endpoint::Kind::kUdpSend:
      return std::make_unique<UdpTransport>(endpoint, false);
    case Endpoint::Kind::kTcp:
      return std::make_unique<TcpTransport>(endpoint);
    case Endpoint::Kind::kSerial:
      break;
  }
  return std::make_unique<SerialTransport>(endpoint);
}

}  // namespace ajna::flight
