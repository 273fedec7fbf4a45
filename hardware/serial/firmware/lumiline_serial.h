/*
 * The device's side of Lumiline's line-scan protocol: messages are encoded, commands decoded.
 *
 * C99, without allocation and without a library: 64 bytes of table, 276 bytes of memory for an
 * encoder and 284 for a receiver. The protocol byte by byte: docs/reference/serial-protocol.md.
 *
 * A device
 *   1. calls lumiline_encoder_init with the function that writes to its UART or USB,
 *   2. sends its description after power-on,
 *   3. gives each received byte to lumiline_receive, obeys the command and answers it,
 *   4. sends each exposure: lumiline_send_lines at once, or in parts,
 *   5. sends its status once a second.
 *
 * An encoder writes one message at a time: use it from one thread or interrupt only.
 */
#ifndef LUMILINE_SERIAL_H
#define LUMILINE_SERIAL_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define LUMILINE_VERSION 1u
#define LUMILINE_ALL_MARKERS 255u
#define LUMILINE_MAX_SLOTS 254u
/* Counts of one message for which it fits into 2^20 bytes, whatever they are. */
#define LUMILINE_MAX_COUNTS 522217u

/* Capabilities of a description. */
#define LUMILINE_CAN_START_STOP 1u
#define LUMILINE_CAN_SET_EXPOSURE 2u
#define LUMILINE_CAN_STROBE 4u

/* Flag of an exposure: a pixel has reached full scale. */
#define LUMILINE_SATURATED 1u

/* Types of commands. */
#define LUMILINE_DESCRIBE 0x81u
#define LUMILINE_START 0x82u
#define LUMILINE_STOP 0x83u
#define LUMILINE_EXPOSURE 0x84u
#define LUMILINE_STROBE 0x85u

/* Results of commands. */
#define LUMILINE_DONE 0u
#define LUMILINE_UNKNOWN 1u
#define LUMILINE_IMPOSSIBLE 2u
#define LUMILINE_BUSY 3u

/* Writes bytes to the line; waits until there is room for them. */
typedef void (*lumiline_write)(void* context, const uint8_t* bytes, size_t size);

/* A message that is being encoded; its members are the encoder's own. */
typedef struct {
    lumiline_write write;
    void* context;
    uint32_t crc;
    uint8_t length;
    bool after_full_block;
    uint8_t block[255];
} lumiline_encoder;

/* The device. Names are UTF-8 with 1 to 64 bytes; those of the sensors differ. */
typedef struct {
    uint8_t capabilities;
    uint8_t bits;       /* of the conversion, 1 to 16 */
    uint8_t sensors;    /* 1 to 64 */
    uint8_t markers;    /* strobed markers, at most 254; 0: all are lit together */
    uint16_t pixels;    /* of each sensor */
    uint8_t clock_bits; /* the clock wraps after 2^clock_bits ticks; 16 to 64 */
    uint32_t clock_hz;
    float pitch_um;
    float electrons_per_count;
    float read_noise_electrons;
    float offset_counts; /* count without light */
    float frame_rate_hz; /* as it is set now; 0: not known, as with those below */
    float exposure_us;
    float delay_us; /* from the centre of an exposure to its first byte on the line */
    float stripe_sigma_px;
    const char* name;
    const char* const* sensor_names;
} lumiline_description;

/* One exposure, or the part of it that begins with count `first` of its sensors x pixels. */
typedef struct {
    uint8_t marker; /* the strobed marker that was lit; LUMILINE_ALL_MARKERS */
    uint8_t flags;
    uint32_t sequence; /* counts all exposures since power-on, sent or not */
    uint64_t ticks;    /* the clock at the centre of the exposure */
    uint32_t lost;     /* exposures that could not be sent since power-on */
    uint32_t first;
} lumiline_lines;

typedef struct {
    uint64_t ticks;
    float temperature_c; /* NAN: not known */
    uint32_t lost;
    uint32_t discarded; /* of the receiver */
} lumiline_status;

/* A command of the host. `slots` are valid until the next byte is received. */
typedef struct {
    uint8_t type;
    uint16_t number;
    float frame_rate_hz; /* of LUMILINE_EXPOSURE; 0: unchanged */
    float exposure_us;   /* of LUMILINE_EXPOSURE; 0: unchanged */
    uint8_t slot_count;  /* of LUMILINE_STROBE; 0: all markers are lit in all exposures */
    const uint8_t* slots;
} lumiline_command;

/* Bytes of a command that is being received; all zero at first. */
typedef struct {
    uint32_t discarded; /* messages that were damaged, too long, or of another version */
    uint16_t length;
    bool too_long;
    uint8_t bytes[272];
} lumiline_receiver;

/* Prepares an encoder, and writes the zero that ends whatever stands on the line. */
void lumiline_encoder_init(lumiline_encoder* encoder, lumiline_write write, void* context);

/* What is wrong with a description, for which the host would refuse it; NULL: nothing. */
const char* lumiline_check_description(const lumiline_description* description);

void lumiline_send_description(lumiline_encoder* encoder, const lumiline_description* description);

/* Sends an exposure, or a part of it, in one message of at most LUMILINE_MAX_COUNTS counts. */
void lumiline_send_lines(lumiline_encoder* encoder, const lumiline_lines* lines,
                         const uint16_t* counts, size_t count);

/* The same in steps, for counts that come one after another: begin, any number of adds, end. */
void lumiline_begin_lines(lumiline_encoder* encoder, const lumiline_lines* lines);
void lumiline_add_counts(lumiline_encoder* encoder, const uint16_t* counts, size_t count);
void lumiline_end_lines(lumiline_encoder* encoder);

void lumiline_send_status(lumiline_encoder* encoder, const lumiline_status* status);

/* Answers a command by one of the results above; LUMILINE_DESCRIBE needs no answer. */
void lumiline_send_answer(lumiline_encoder* encoder, const lumiline_command* command,
                          uint8_t result);

/*
 * Takes one received byte; true: it completed a command, which is now in `command`.
 * Answer a type that you do not know with LUMILINE_UNKNOWN.
 */
bool lumiline_receive(lumiline_receiver* receiver, uint8_t byte, lumiline_command* command);

#ifdef __cplusplus
}
#endif

#endif
