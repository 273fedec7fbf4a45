function stream(url, device, seconds)
% STREAM  Plot the points of a Lumiline device as they come.
%   stream("http://127.0.0.1:8000", "sim", 10)
%
% MATLAB has no websockets of its own, so it uses the Python client:
%   pyenv(Version="/path/to/python")  % one with `pip install ./lumiline`
% Untested: nobody of ours has MATLAB.
arguments
    url (1,1) string = "http://127.0.0.1:8000"
    device (1,1) string = "sim"
    seconds (1,1) double = 10
end
client = py.lumiline.client.Client(url);
open_stream = client.stream(device, py.list({"points"}), pyargs("rate_hz", 30));
close_all = onCleanup(@() cellfun(@(one) one.close(), {open_stream, client}));
messages = open_stream.frames();
figure; hold on; grid on; axis equal; view(3);
xlabel("x [mm]"); ylabel("y [mm]"); zlabel("z [mm]");
began = tic;
while toc(began) < seconds
    frame = py.next(messages);
    for point = cell(frame.points)
        if ~isa(point{1}.position_mm, "py.NoneType")
            position = double(py.array.array("d", point{1}.position_mm));
            plot3(position(1), position(2), position(3), ".");
        end
    end
    drawnow limitrate
end
end
