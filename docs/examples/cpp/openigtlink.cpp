// Prints the tools' poses that a server sends by OpenIGTLink: ./openigtlink HOST PORT
// Debian: apt install g++ libopenigtlink-dev
// g++ -std=c++17 -O2 openigtlink.cpp -isystem /usr/include/openigtlink -lOpenIGTLink -o openigtlink
#include <igtlClientSocket.h>
#include <igtlMessageHeader.h>
#include <igtlStatusMessage.h>
#include <igtlTimeStamp.h>
#include <igtlTransformMessage.h>

#include <cstdio>
#include <cstdlib>
#include <cstring>

// Receives the body of a message and checks its CRC.
template <typename Message>
static bool receive(igtl::ClientSocket* socket, igtl::MessageHeader* header, Message& message) {
    bool timed_out = false;
    message->SetMessageHeader(header);
    message->AllocatePack();
    socket->Receive(message->GetPackBodyPointer(), message->GetPackBodySize(), timed_out);
    return (message->Unpack(1) & igtl::MessageHeader::UNPACK_BODY) != 0;
}

int main(int count, char** arguments) {
    if (count < 3) {
        std::fprintf(stderr, "usage: openigtlink HOST PORT\n");
        return 2;
    }
    igtl::ClientSocket::Pointer socket = igtl::ClientSocket::New();
    if (socket->ConnectToServer(arguments[1], std::atoi(arguments[2])) != 0) {
        std::fprintf(stderr, "%s:%s does not answer\n", arguments[1], arguments[2]);
        return 1;
    }
    igtl::MessageHeader::Pointer header = igtl::MessageHeader::New();
    for (;;) {
        bool timed_out = false;
        header->InitPack();
        const auto received =
            socket->Receive(header->GetPackPointer(), header->GetPackSize(), timed_out);
        if (static_cast<int>(received) != header->GetPackSize()) return 0;  // closed by the server
        header->Unpack();
        igtl::TimeStamp::Pointer exposure = igtl::TimeStamp::New();
        header->GetTimeStamp(exposure);
        if (std::strcmp(header->GetDeviceType(), "TRANSFORM") == 0) {
            igtl::TransformMessage::Pointer transform = igtl::TransformMessage::New();
            igtl::Matrix4x4 matrix;
            if (!receive(socket, header, transform)) continue;
            transform->GetMatrix(matrix);
            std::printf("%.6f %s %.3f %.3f %.3f mm\n", exposure->GetTimeStamp(),
                        transform->GetDeviceName(), matrix[0][3], matrix[1][3], matrix[2][3]);
        } else if (std::strcmp(header->GetDeviceType(), "STATUS") == 0) {
            // A tool was lost or is back, or a beam hold has changed; only code 1 is good.
            igtl::StatusMessage::Pointer status = igtl::StatusMessage::New();
            if (!receive(socket, header, status)) continue;
            std::printf("%.6f %s status %d %s: %s\n", exposure->GetTimeStamp(),
                        status->GetDeviceName(), status->GetCode(), status->GetErrorName(),
                        status->GetStatusString());
        } else {
            socket->Skip(header->GetBodySizeToRead(), timed_out);
        }
        std::fflush(stdout);
    }
}
