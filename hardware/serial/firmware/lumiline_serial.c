/* The device's side of Lumiline's line-scan protocol; see lumiline_serial.h. */
#include "lumiline_serial.h"

#include <float.h>
#include <limits.h>
#include <string.h>

/* Floats are IEEE 754 binary32, bytes have 8 bits; the compiler stops here where they do not. */
typedef char lumiline_float_is_binary32[sizeof(float) == 4 && FLT_MANT_DIG == 24 ? 1 : -1];
typedef char lumiline_byte_has_8_bits[CHAR_BIT == 8 ? 1 : -1];

enum {
    TYPE_DESCRIPTION = 0x01,
    TYPE_LINES = 0x02,
    TYPE_STATUS = 0x03,
    TYPE_ANSWER = 0x04,
    BLOCK = 254,       /* most bytes between two codes of COBS */
    CHECKSUM = 4,      /* bytes */
    COMMAND_HEAD = 4,  /* version, type, number */
    MAX_MARKERS = 254, /* 0 to 253 */
    MAX_NAME = 64
};

/* CRC-32 of Ethernet and zip, half a byte at a time. */
static const uint32_t crc_table[16] = {
    0x00000000u, 0x1db71064u, 0x3b6e20c8u, 0x26d930acu, 0x76dc4190u, 0x6b6b51f4u,
    0x4db26158u, 0x5005713cu, 0xedb88320u, 0xf00f9344u, 0xd6d6a3e8u, 0xcb61b38cu,
    0x9b64c2b0u, 0x86d3d2d4u, 0xa00ae278u, 0xbdbdf21cu,
};

static uint32_t crc_add(uint32_t crc, uint8_t byte) {
    crc ^= byte;
    crc = (crc >> 4) ^ crc_table[crc & 15u];
    return (crc >> 4) ^ crc_table[crc & 15u];
}

static void end_block(lumiline_encoder* encoder) {
    encoder->block[0] = (uint8_t)(encoder->length + 1u);
    encoder->write(encoder->context, encoder->block, encoder->length + 1u);
    encoder->after_full_block = encoder->length == BLOCK;
    encoder->length = 0;
}

/* Adds a byte by consistent overhead byte stuffing. */
static void stuff(lumiline_encoder* encoder, uint8_t byte) {
    if (byte == 0) {
        end_block(encoder);
        return;
    }
    encoder->block[++encoder->length] = byte;
    if (encoder->length == BLOCK) end_block(encoder);
}

static void put_u8(lumiline_encoder* encoder, uint8_t value) {
    encoder->crc = crc_add(encoder->crc, value);
    stuff(encoder, value);
}

static void put_u16(lumiline_encoder* encoder, uint16_t value) {
    put_u8(encoder, (uint8_t)(value & 0xffu));
    put_u8(encoder, (uint8_t)(value >> 8));
}

static void put_u32(lumiline_encoder* encoder, uint32_t value) {
    put_u16(encoder, (uint16_t)(value & 0xffffu));
    put_u16(encoder, (uint16_t)(value >> 16));
}

static void put_u64(lumiline_encoder* encoder, uint64_t value) {
    put_u32(encoder, (uint32_t)(value & 0xffffffffu));
    put_u32(encoder, (uint32_t)(value >> 32));
}

static void put_f32(lumiline_encoder* encoder, float value) {
    uint32_t bits;
    memcpy(&bits, &value, sizeof bits);
    put_u32(encoder, bits);
}

static void put_name(lumiline_encoder* encoder, const char* name) {
    size_t length = strlen(name);
    put_u8(encoder, (uint8_t)length);
    while (length-- > 0) put_u8(encoder, (uint8_t)*name++);
}

static void begin(lumiline_encoder* encoder, uint8_t type) {
    encoder->crc = 0xffffffffu;
    encoder->length = 0;
    encoder->after_full_block = false;
    put_u8(encoder, LUMILINE_VERSION);
    put_u8(encoder, type);
}

static void end(lumiline_encoder* encoder) {
    static const uint8_t zero = 0;
    const uint32_t crc = ~encoder->crc;
    put_u32(encoder, crc);
    /* After a full block the end needs no code of its own. */
    if (encoder->length > 0 || !encoder->after_full_block) end_block(encoder);
    encoder->write(encoder->context, &zero, 1);
}

void lumiline_encoder_init(lumiline_encoder* encoder, lumiline_write write, void* context) {
    static const uint8_t zero = 0;
    encoder->write = write;
    encoder->context = context;
    encoder->length = 0;
    encoder->after_full_block = false;
    write(context, &zero, 1);
}

static bool is_within(float value, float low, float high) { return value >= low && value <= high; }

static bool is_name(const char* name) {
    const size_t length = strlen(name);
    return length >= 1 && length <= MAX_NAME;
}

const char* lumiline_check_description(const lumiline_description* description) {
    const lumiline_description* d = description;
    uint8_t i, j;
    if (d->bits < 1 || d->bits > 16) return "bits must be 1 to 16";
    if (d->sensors < 1 || d->sensors > 64) return "sensors must be 1 to 64";
    if (d->markers > MAX_MARKERS) return "markers must be 0 to 254";
    if (d->pixels < 1) return "pixels must be 1 or more";
    if (d->clock_bits < 16 || d->clock_bits > 64) return "clock_bits must be 16 to 64";
    if (d->clock_hz < 1) return "clock_hz must be 1 or more";
    if (!is_within(d->pitch_um, 0.0f, 1e9f) || d->pitch_um <= 0.0f)
        return "pitch_um must be above 0, at most 1e9";
    if (!is_within(d->electrons_per_count, 0.0f, 1e9f) || d->electrons_per_count <= 0.0f)
        return "electrons_per_count must be above 0, at most 1e9";
    if (!is_within(d->read_noise_electrons, 0.0f, 1e9f))
        return "read_noise_electrons must be 0 to 1e9";
    if (!is_within(d->offset_counts, -1e9f, 1e9f)) return "offset_counts must be -1e9 to 1e9";
    if (!is_within(d->frame_rate_hz, 0.0f, 1e6f)) return "frame_rate_hz must be 0 to 1e6";
    if (!is_within(d->exposure_us, 0.0f, 1e9f)) return "exposure_us must be 0 to 1e9";
    if (!is_within(d->delay_us, 0.0f, 1e9f)) return "delay_us must be 0 to 1e9";
    if (!is_within(d->stripe_sigma_px, 0.0f, 1e9f)) return "stripe_sigma_px must be 0 to 1e9";
    if (!is_name(d->name)) return "name must have 1 to 64 bytes";
    for (i = 0; i < d->sensors; ++i) {
        if (!is_name(d->sensor_names[i])) return "sensor_names must have 1 to 64 bytes each";
        for (j = 0; j < i; ++j)
            if (strcmp(d->sensor_names[i], d->sensor_names[j]) == 0)
                return "sensor_names must differ";
    }
    return NULL;
}

void lumiline_send_description(lumiline_encoder* encoder, const lumiline_description* description) {
    const lumiline_description* d = description;
    uint8_t i;
    begin(encoder, TYPE_DESCRIPTION);
    put_u8(encoder, d->capabilities);
    put_u8(encoder, d->bits);
    put_u8(encoder, d->sensors);
    put_u8(encoder, d->markers);
    put_u16(encoder, d->pixels);
    put_u8(encoder, d->clock_bits);
    put_u8(encoder, 0);
    put_u32(encoder, d->clock_hz);
    put_f32(encoder, d->pitch_um);
    put_f32(encoder, d->electrons_per_count);
    put_f32(encoder, d->read_noise_electrons);
    put_f32(encoder, d->offset_counts);
    put_f32(encoder, d->frame_rate_hz);
    put_f32(encoder, d->exposure_us);
    put_f32(encoder, d->delay_us);
    put_f32(encoder, d->stripe_sigma_px);
    put_name(encoder, d->name);
    for (i = 0; i < d->sensors; ++i) put_name(encoder, d->sensor_names[i]);
    end(encoder);
}

void lumiline_begin_lines(lumiline_encoder* encoder, const lumiline_lines* lines) {
    begin(encoder, TYPE_LINES);
    put_u8(encoder, lines->marker);
    put_u8(encoder, lines->flags);
    put_u32(encoder, lines->sequence);
    put_u64(encoder, lines->ticks);
    put_u32(encoder, lines->lost);
    put_u32(encoder, lines->first);
}

void lumiline_add_counts(lumiline_encoder* encoder, const uint16_t* counts, size_t count) {
    while (count-- > 0) put_u16(encoder, *counts++);
}

void lumiline_end_lines(lumiline_encoder* encoder) { end(encoder); }

void lumiline_send_lines(lumiline_encoder* encoder, const lumiline_lines* lines,
                         const uint16_t* counts, size_t count) {
    lumiline_begin_lines(encoder, lines);
    lumiline_add_counts(encoder, counts, count);
    lumiline_end_lines(encoder);
}

void lumiline_send_status(lumiline_encoder* encoder, const lumiline_status* status) {
    begin(encoder, TYPE_STATUS);
    put_u16(encoder, 0);
    put_u64(encoder, status->ticks);
    put_f32(encoder, status->temperature_c);
    put_u32(encoder, status->lost);
    put_u32(encoder, status->discarded);
    end(encoder);
}

void lumiline_send_answer(lumiline_encoder* encoder, const lumiline_command* command,
                          uint8_t result) {
    begin(encoder, TYPE_ANSWER);
    put_u8(encoder, command->type);
    put_u8(encoder, result);
    put_u16(encoder, command->number);
    end(encoder);
}

/* Removes the stuffing in place; the number of bytes, or 0 where it is none. */
static size_t unstuff(uint8_t* bytes, size_t length) {
    size_t from = 0, to = 0;
    while (from < length) {
        const size_t code = bytes[from++];
        if (code - 1u > length - from) return 0;
        memmove(bytes + to, bytes + from, code - 1u);
        to += code - 1u;
        from += code - 1u;
        if (code <= BLOCK && from < length) bytes[to++] = 0;
    }
    return to;
}

static bool is_intact(const uint8_t* bytes, size_t length) {
    uint32_t crc = 0xffffffffu;
    size_t i;
    for (i = 0; i < length; ++i) crc = crc_add(crc, bytes[i]);
    return crc == 0xdebb20e3u; /* of anything that its own checksum follows */
}

static float f32_at(const uint8_t* bytes) {
    const uint32_t bits = (uint32_t)bytes[0] | (uint32_t)bytes[1] << 8 | (uint32_t)bytes[2] << 16
                          | (uint32_t)bytes[3] << 24;
    float value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

/* Reads the command of an intact message without its checksum; false: its content is wrong. */
static bool parse(const uint8_t* content, size_t length, lumiline_command* command) {
    size_t i;
    if (length < COMMAND_HEAD || content[0] != LUMILINE_VERSION || content[1] < 0x80u) return false;
    memset(command, 0, sizeof *command);
    command->type = content[1];
    command->number = (uint16_t)(content[2] | content[3] << 8);
    if (command->type == LUMILINE_EXPOSURE) {
        if (length < COMMAND_HEAD + 8) return false;
        command->frame_rate_hz = f32_at(content + COMMAND_HEAD);
        command->exposure_us = f32_at(content + COMMAND_HEAD + 4);
        return is_within(command->frame_rate_hz, 0.0f, FLT_MAX)
               && is_within(command->exposure_us, 0.0f, FLT_MAX);
    }
    if (command->type == LUMILINE_STROBE) {
        if (length < COMMAND_HEAD + 1u || length < COMMAND_HEAD + 1u + content[COMMAND_HEAD])
            return false;
        command->slot_count = content[COMMAND_HEAD];
        command->slots = content + COMMAND_HEAD + 1;
        for (i = 0; i < command->slot_count; ++i)
            if (command->slots[i] == MAX_MARKERS) return false;
    }
    return true;
}

bool lumiline_receive(lumiline_receiver* receiver, uint8_t byte, lumiline_command* command) {
    size_t length = receiver->length;
    const bool too_long = receiver->too_long;
    if (byte != 0) {
        receiver->too_long = too_long || length == sizeof receiver->bytes;
        if (!receiver->too_long) receiver->bytes[receiver->length++] = byte;
        return false;
    }
    receiver->length = 0;
    receiver->too_long = false;
    if (length == 0) return false; /* zeros between messages */
    if (!too_long) {
        length = unstuff(receiver->bytes, length);
        if (length > CHECKSUM && is_intact(receiver->bytes, length)
            && parse(receiver->bytes, length - CHECKSUM, command))
            return true;
    }
    receiver->discarded += 1;
    return false;
}
