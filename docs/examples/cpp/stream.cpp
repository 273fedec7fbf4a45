// Prints the points of a device's stream: ./stream HOST PORT DEVICE [KEY]
// Debian: apt install g++ libboost-dev nlohmann-json3-dev
// g++ -std=c++17 -O2 stream.cpp -pthread -o stream
#include <boost/asio/connect.hpp>
#include <boost/asio/ip/tcp.hpp>
#include <boost/beast/core.hpp>
#include <boost/beast/websocket.hpp>
#include <iostream>
#include <nlohmann/json.hpp>
#include <string>

namespace asio = boost::asio;
namespace beast = boost::beast;
namespace websocket = beast::websocket;
using nlohmann::json;

static void show(const json& frame) {
    for (const json& point : frame.at("points")) {
        std::cout << frame.at("sequence") << ' ' << frame.at("exposure_ns") << ' ';
        if (point.at("position_mm").is_null())
            std::cout << "no position: " << point.at("flags") << '\n';
        else
            std::cout << point.at("marker") << ' ' << point.at("position_mm") << " mm\n";
    }
}

int main(int count, char** arguments) {
    if (count < 4) {
        std::cerr << "usage: stream HOST PORT DEVICE [KEY]\n";
        return 2;
    }
    const std::string host = arguments[1], port = arguments[2], device = arguments[3];
    try {
        asio::io_context context;
        websocket::stream<asio::ip::tcp::socket> stream(context);
        asio::ip::tcp::resolver resolver(context);
        asio::connect(stream.next_layer(), resolver.resolve(host, port));
        stream.next_layer().set_option(asio::ip::tcp::no_delay(true));
        if (count > 4) {
            const std::string key = arguments[4];
            stream.set_option(
                websocket::stream_base::decorator([key](websocket::request_type& request) {
                    request.set(beast::http::field::authorization, "Bearer " + key);
                }));
        }
        stream.handshake(host + ":" + port, "/api/v1/stream?content=points&device_id=" + device);
        for (;;) {
            beast::flat_buffer buffer;
            stream.read(buffer);
            const auto* bytes = static_cast<const std::uint8_t*>(buffer.data().data());
            const json message = json::from_msgpack(bytes, bytes + buffer.size());
            const std::string type = message.at("type");
            if (type == "frame")
                show(message);
            else if (type == "state")
                std::cerr << "device: " << message.at("state") << ' ' << message.at("reason")
                          << '\n';
            else if (type == "missed")
                std::cerr << "missed: " << message << '\n';
        }
    } catch (const beast::system_error& error) {
        // Also the end: the server closes the stream when it stops or the device is deleted.
        std::cerr << "the stream ended: " << error.what() << '\n';
        return error.code() == websocket::error::closed ? 0 : 1;
    }
}
