function openigtlink(host, port, seconds)
% OPENIGTLINK  Print the tools' poses that a Lumiline server sends by OpenIGTLink.
%   openigtlink("127.0.0.1", 18944, 10)
%
% Needs MATLAB R2020b or newer (tcpclient), no toolbox. Untested: nobody of ours has MATLAB.
% A message: 58 bytes of header, then the body; numbers are big-endian.
arguments
    host (1,1) string = "127.0.0.1"
    port (1,1) double = 18944
    seconds (1,1) double = 10
end
server = tcpclient(host, port, "Timeout", 5);
server.ByteOrder = "big-endian";
began = tic;
while toc(began) < seconds
    read(server, 1, "uint16");                        % version
    kind = text(read(server, 12, "uint8"));
    name = text(read(server, 20, "uint8"));
    whole = read(server, 1, "uint32");                % time of the exposure [s], and
    fraction = read(server, 1, "uint32") / 2^32;      % its fraction
    count = read(server, 1, "uint64");
    read(server, 1, "uint64");                        % CRC-64 of the body
    body = uint8(read(server, double(count), "uint8"));
    if kind == "TRANSFORM"
        values = double(swapbytes(typecast(body(1:48), "single")));
        matrix = [reshape(values, 3, 4); 0 0 0 1];    % tool to tracker, translation in mm
        fprintf("%.3f %s %8.2f %8.2f %8.2f mm\n", double(whole) + fraction, name, matrix(1:3, 4));
    elseif kind == "STATUS"
        % A tool was lost or is back, or a beam hold has changed; only code 1 is good.
        code = swapbytes(typecast(body(1:2), "uint16"));
        fprintf("%.3f %s status %d: %s\n", double(whole) + fraction, name, code, text(body(31:end)));
    end
end
end

function found = text(bytes)
% The characters before the first zero.
found = string(char(bytes(1:min([find(bytes == 0, 1) - 1, numel(bytes)]))));
end
