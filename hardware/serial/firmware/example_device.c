/*
 * Example of a device: a bar of four TCD1304 that sees a waved wand, on a TCP port.
 *
 * `cc -std=c99 -O2 example_device.c lumiline_serial.c -lm -o example_device && ./example_device
 * 5000` is the serial device `socket://127.0.0.1:5000`. What a firmware has of its own instead:
 * `expose` reads the sensors, `read_clock` a timer, `write_line` and `main` the UART or USB.
 */
#define _POSIX_C_SOURCE 200809L
#include <arpa/inet.h>
#include <math.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#include "lumiline_serial.h"

enum { SENSORS = 4, PIXELS = 3648, MARKERS = 2, FULL_SCALE = 4095, OFFSET = 64 };

static const char* const sensor_names[SENSORS] = {"down", "right", "rising", "falling"};

typedef struct {
    lumiline_description description;
    lumiline_encoder encoder;
    lumiline_receiver receiver;
    uint8_t slots[LUMILINE_MAX_SLOTS];
    uint8_t slot_count;
    uint32_t sequence;
    bool is_running;
    uint16_t counts[SENSORS * PIXELS];
} device;

/* The clock of the exposures: microseconds since power-on. */
static uint64_t read_clock(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * 1000000u + (uint64_t)now.tv_nsec / 1000u;
}

/* The scene. x points to the right, y down and z forward, as seen from the bar [mm]. */

typedef struct {
    double x, y, z;
} vector;

static double dot(vector a, vector b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

static vector add(vector a, double factor, vector b) {
    const vector sum = {a.x + factor * b.x, a.y + factor * b.y, a.z + factor * b.z};
    return sum;
}

static vector unit(vector a) {
    const vector zero = {0.0, 0.0, 0.0};
    return add(zero, 1.0 / sqrt(dot(a, a)), a);
}

/* A wand of 300 mm, waved through a volume of about 0.5 m at 1.5 m. */
static vector marker_position(int marker, double seconds) {
    const vector centre = {240.0 * sin(1.31 * seconds), 220.0 * sin(1.73 * seconds + 1.0),
                           1500.0 + 240.0 * sin(0.97 * seconds + 2.0)};
    const double polar = 1.2 * sin(2.1 * seconds), azimuth = 1.57 * seconds;
    const vector direction = {cos(polar) * cos(azimuth), cos(polar) * sin(azimuth), sin(polar)};
    return add(centre, marker == 0 ? -150.0 : 150.0, direction);
}

/* Where the stripe of a light crosses a sensor [px]: a lens of 37 mm aimed at the volume. */
static double stripe_position(int sensor, vector light) {
    static const vector lenses[SENSORS] = {
        {250.0, 86.0, 0.0}, {-250.0, 86.0, 0.0}, {291.0, -86.0, 0.0}, {-291.0, -86.0, 0.0}};
    static const vector directions[SENSORS] = {
        {0.0, 1.0, 0.0}, {1.0, 0.0, 0.0}, {0.7071, 0.7071, 0.0}, {-0.7071, 0.7071, 0.0}};
    const vector centre = {0.0, 0.0, 1500.0};
    const vector axis = unit(add(centre, -1.0, lenses[sensor]));
    const vector along = unit(add(directions[sensor], -dot(directions[sensor], axis), axis));
    const vector ray = add(light, -1.0, lenses[sensor]);
    return 0.5 * (PIXELS - 1) + 37.0 / 0.008 * dot(ray, along) / dot(ray, axis);
}

/* Noise of about 4 counts: the sum of four uniform numbers, less its mean. */
static double noise(void) {
    static uint32_t state = 1;
    double sum = 0.0;
    int i;
    for (i = 0; i < 4; ++i) {
        state = state * 1664525u + 1013904223u;
        sum += (double)(state >> 8) / 16777216.0 - 0.5;
    }
    return 7.0 * sum;
}

/* Reads all sensors while a marker is lit, or all; returns the flags of the exposure. */
static uint8_t expose(uint16_t* counts, uint8_t lit, double seconds) {
    uint8_t flags = 0;
    int sensor, marker, i;
    for (sensor = 0; sensor < SENSORS; ++sensor, counts += PIXELS) {
        for (i = 0; i < PIXELS; ++i) counts[i] = (uint16_t)(OFFSET + noise() + 20.5);
        for (marker = 0; marker < MARKERS; ++marker) {
            double position;
            if (lit != LUMILINE_ALL_MARKERS && lit != marker) continue;
            position = stripe_position(sensor, marker_position(marker, seconds));
            for (i = (int)position - 20; i <= (int)position + 20; ++i) {
                double value, distance = (i - position) / 3.0;
                if (i < 0 || i >= PIXELS) continue;
                value = counts[i] + 2000.0 * exp(-0.5 * distance * distance);
                if (value >= FULL_SCALE) flags = LUMILINE_SATURATED;
                counts[i] = (uint16_t)(value < FULL_SCALE ? value : FULL_SCALE);
            }
        }
    }
    return flags;
}

static void describe(device* d) {
    lumiline_description* of = &d->description;
    memset(of, 0, sizeof *of);
    of->capabilities = LUMILINE_CAN_START_STOP | LUMILINE_CAN_SET_EXPOSURE | LUMILINE_CAN_STROBE;
    of->bits = 12;
    of->sensors = SENSORS;
    of->markers = MARKERS;
    of->pixels = PIXELS;
    of->clock_bits = 64;
    of->clock_hz = 1000000;
    of->pitch_um = 8.0f;
    of->electrons_per_count = 30.0f;
    of->read_noise_electrons = 120.0f;
    of->offset_counts = OFFSET + 20;
    of->frame_rate_hz = 100.0f;
    of->exposure_us = 1000.0f;
    of->stripe_sigma_px = 3.0f;
    of->name = "example bar";
    of->sensor_names = sensor_names;
}

static uint8_t obey(device* d, const lumiline_command* command) {
    switch (command->type) {
        case LUMILINE_START:
            d->is_running = true;
            return LUMILINE_DONE;
        case LUMILINE_STOP:
            d->is_running = false;
            return LUMILINE_DONE;
        case LUMILINE_EXPOSURE:
            if (command->frame_rate_hz > 500.0f) return LUMILINE_IMPOSSIBLE;
            if (command->frame_rate_hz > 0.0f)
                d->description.frame_rate_hz = command->frame_rate_hz;
            if (command->exposure_us > 0.0f) d->description.exposure_us = command->exposure_us;
            return LUMILINE_DONE;
        case LUMILINE_STROBE: {
            uint8_t i;
            for (i = 0; i < command->slot_count; ++i)
                if (command->slots[i] >= MARKERS && command->slots[i] != LUMILINE_ALL_MARKERS)
                    return LUMILINE_IMPOSSIBLE;
            if (command->slot_count > 0) memcpy(d->slots, command->slots, command->slot_count);
            d->slot_count = command->slot_count;
            return LUMILINE_DONE;
        }
        default:
            return LUMILINE_UNKNOWN;
    }
}

static void take_byte(device* d, uint8_t byte) {
    lumiline_command command;
    if (!lumiline_receive(&d->receiver, byte, &command)) return;
    if (command.type == LUMILINE_DESCRIBE)
        lumiline_send_description(&d->encoder, &d->description);
    else
        lumiline_send_answer(&d->encoder, &command, obey(d, &command));
}

static void send_exposure(device* d) {
    lumiline_lines lines = {LUMILINE_ALL_MARKERS, 0, 0, 0, 0, 0};
    lines.sequence = d->sequence++;
    lines.ticks = read_clock();
    if (d->slot_count > 0) lines.marker = d->slots[lines.sequence % d->slot_count];
    lines.flags = expose(d->counts, lines.marker, 1e-6 * (double)lines.ticks);
    lumiline_send_lines(&d->encoder, &lines, d->counts, SENSORS * PIXELS);
}

static void send_status(device* d) {
    lumiline_status status = {0, NAN, 0, 0};
    status.ticks = read_clock();
    status.discarded = d->receiver.discarded;
    lumiline_send_status(&d->encoder, &status);
}

/* The line: a connection of TCP. */

static FILE* line;

static void write_line(void* context, const uint8_t* bytes, size_t size) {
    (void)context;
    if (line != NULL && fwrite(bytes, 1, size, line) != size) line = NULL;
}

static void serve(device* d, int connection) {
    uint64_t next_exposure = read_clock(), next_status = next_exposure;
    lumiline_encoder_init(&d->encoder, write_line, NULL);
    lumiline_send_description(&d->encoder, &d->description);
    while (line != NULL) {
        struct pollfd readable = {connection, POLLIN, 0};
        const uint64_t now = read_clock();
        if (now >= next_status) {
            send_status(d);
            next_status = now + 1000000u;
        }
        if (!d->is_running)
            next_exposure = now + 5000u;
        else if (now >= next_exposure) {
            send_exposure(d);
            next_exposure += (uint64_t)(1e6f / d->description.frame_rate_hz);
        }
        if (line == NULL || fflush(line) != 0) return;
        if (poll(&readable, 1, next_exposure > now ? (int)((next_exposure - now) / 1000u) : 0)
            > 0) {
            uint8_t bytes[256];
            const ssize_t size = read(connection, bytes, sizeof bytes);
            ssize_t i;
            if (size <= 0) return;
            for (i = 0; i < size; ++i) take_byte(d, bytes[i]);
        }
    }
}

int main(int argument_count, char** arguments) {
    static device the_device;
    struct sockaddr_in address = {0};
    socklen_t size = sizeof address;
    const int listener = socket(AF_INET, SOCK_STREAM, 0), yes = 1;
    const char* wrong;
    describe(&the_device);
    wrong = lumiline_check_description(&the_device.description);
    if (wrong != NULL) {
        fprintf(stderr, "the description is wrong: %s\n", wrong);
        return 1;
    }
    signal(SIGPIPE, SIG_IGN);
    address.sin_family = AF_INET;
    address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    address.sin_port = htons((uint16_t)(argument_count > 1 ? atoi(arguments[1]) : 0));
    setsockopt(listener, SOL_SOCKET, SO_REUSEADDR, &yes, sizeof yes);
    if (bind(listener, (struct sockaddr*)&address, size) != 0 || listen(listener, 1) != 0) {
        perror("the port cannot be opened");
        return 1;
    }
    getsockname(listener, (struct sockaddr*)&address, &size);
    printf("socket://127.0.0.1:%d\n", ntohs(address.sin_port));
    fflush(stdout);
    for (;;) {
        const int connection = accept(listener, NULL, NULL);
        FILE* opened = connection < 0 ? NULL : fdopen(connection, "w");
        if (opened == NULL) continue;
        line = opened;
        serve(&the_device, connection);
        fclose(opened);
    }
}
