// A controller in C++: drives one lap on the answers of the perception service. POSIX alone.
//     simulator link --track oval --camera 280x210 --name /driverview &
//     serve &
//     simulator link --header driverview_link.h
//     g++ -std=c++17 -O2 -I. -o drive examples/drive.cpp && ./drive /driverview 127.0.0.1 8000
// Images and the car's own speeds come through shared memory; the service gets each image as raw
// pixels (/v2, Open Inference Protocol). State feedback steers; throttle and gear are held. The true
// offset in the link is read for the printed figures only.
#include <netdb.h>
#include <netinet/tcp.h>
#include <sys/socket.h>
#include <algorithm>
#include <stdexcept>
#include <string>
#include "driverview_link.h"

// m left of the lane's centre, NaN where no lane is seen; rad, positive when the car points right.
struct Road { float offset, angle; };

// A connection to the first address of `host` that answers; each operation may take 5 s.
static int dial(const char *host, const char *port) {
    addrinfo hints{}, *found = nullptr;
    hints.ai_socktype = SOCK_STREAM;
    if (getaddrinfo(host, port, &hints, &found)) throw std::runtime_error("unknown host");
    int connection = -1, yes = 1;
    const timeval limit{5, 0};
    for (const addrinfo *at = found; at && connection < 0; at = at->ai_next) {
        connection = socket(at->ai_family, at->ai_socktype, at->ai_protocol);
        for (const int each : {SO_SNDTIMEO, SO_RCVTIMEO})
            setsockopt(connection, SOL_SOCKET, each, &limit, sizeof limit);
        if (connection < 0 || !connect(connection, at->ai_addr, at->ai_addrlen)) continue;
        close(connection), connection = -1;
    }
    freeaddrinfo(found);
    if (connection < 0) throw std::runtime_error("no service");
    setsockopt(connection, IPPROTO_TCP, TCP_NODELAY, &yes, sizeof yes);
    return connection;
}

// The request for one image, with the token in $DRIVERVIEW_TOKEN if it is set; its pixels follow.
static std::string request_for(const drvlink_header &camera, const std::string &host) {
    const auto height = camera.image_height, width = camera.image_width;
    const size_t bytes = size_t{3} * width * height;
    const char *token = getenv("DRIVERVIEW_TOKEN");
    const std::string json =
        R"({"inputs":[{"name":"pixels","datatype":"UINT8","shape":[1,)" + std::to_string(height) +
        "," + std::to_string(width) + R"(,3],"parameters":{"binary_data_size":)" +
        std::to_string(bytes) + R"(}}],"outputs":[{"name":"to_lane_centre_m",)"
        R"("parameters":{"binary_data":true}},{"name":"angle_rad","parameters":{"binary_data":true}}]})";
    return "POST /v2/models/track/infer HTTP/1.1\r\nHost: " + host +
           (token ? std::string("\r\nAuthorization: Bearer ") + token : "") +
           "\r\nContent-Type: application/octet-stream\r\nInference-Header-Content-Length: " +
           std::to_string(json.size()) + "\r\nContent-Length: " +
           std::to_string(json.size() + bytes) + "\r\nConnection: close\r\n\r\n" + json;
}

// A connection for each image: one that is kept would be closed by the service when the car waits.
static Road ask(const char *host, const char *port, const std::string &request) {
    const int connection = dial(host, port);
    for (size_t sent = 0; sent < request.size();) {
        const ssize_t more = send(connection, &request[sent], request.size() - sent, MSG_NOSIGNAL);
        if (more <= 0) throw std::runtime_error("the service closed the connection");
        sent += static_cast<size_t>(more);
    }
    std::string reply;
    char part[4096];
    for (ssize_t more; (more = recv(connection, part, sizeof part, 0)) > 0;)
        reply.append(part, static_cast<size_t>(more));
    close(connection);
    if (reply.compare(0, 12, "HTTP/1.1 200")) throw std::runtime_error("no answer: " + reply);
    Road road;  // the two tensors asked for are the last bytes, little-endian
    memcpy(&road, &reply[reply.size() - sizeof road], sizeof road);
    return road;
}

int main(int count, char **words) try {
    if (count != 4) throw std::runtime_error("usage: drive /NAME HOST PORT");
    drvlink link;
    const auto check = [&](int failed) { if (failed) throw std::runtime_error(link.error); };
    check(drvlink_attach(&link, words[1], 180.0)), link.timeout_s = 30.0;
    const drvlink_header &world = link.header;
    const drvlink_state &car = link.state;
    std::string host(words[2], strcspn(words[2], "%"));  // without the zone of an IPv6 address
    if (strchr(words[2], ':')) host = "[" + host + "]";
    const std::string request = request_for(world, host + ":" + words[3]);
    const size_t bytes = size_t{3} * world.image_width * world.image_height;
    std::string image(world.image_bytes, 0);  // the bytes of the pixels, and up to 7 more
    link.image = reinterpret_cast<uint8_t *>(image.data());
    double sum = 0.0, largest = 0.0, offset = 0.0;
    check(drvlink_reset(&link, 1));
    while (car.lap < 2) {  // from 25 m before the line, at rest, to the end of the first lap
        const Road road = ask(words[2], words[3], request + image.substr(0, bytes));
        if (std::isfinite(road.offset)) offset = road.offset;  // otherwise the last one is held
        const double theta = -road.angle, rate = car.vy + car.vx * std::sin(theta);
        const double wheel = -(0.4 * offset + 0.1 * rate + 1.5 * theta + 0.1 * car.yaw_rate);
        check(drvlink_step(&link, std::clamp(wheel / world.steering_lock, -1.0, 1.0), 0.2, 0.0, 1));
        if (car.ended) throw std::runtime_error("the car has left the road");
        sum += std::fabs(car.to_middle), largest = std::fmax(largest, std::fabs(car.to_middle));
    }
    const double steps = static_cast<double>(car.step);
    printf("lap done: %.0f steps, mean |d| %.4f m, largest |d| %.4f m\n", steps, sum / steps, largest);
    return drvlink_detach(&link), 0;
} catch (const std::exception &error) {
    return fprintf(stderr, "error: %s\n", error.what()), 1;
}
