/* What a dashboard ECU does with three of our frames, by the rules of dbc/README.md, whose C is in here.  A candump log in,
 * a line a frame out, and a line each time when the state to show changes:
 *
 *     <message> good <lost frames> <value or code of each signal>...
 *     <message> wrong_length | wrong_checksum | repeated | second_sender | stale
 *     verdict unknown | no_go | caution | go
 *     - foreign
 *
 * From the repository's root (cantools writes soilbus.h and soilbus.c):
 *
 *     python -m cantools generate_c_source dbc/soilbus.dbc &&
 *         gcc -std=c99 -Wall -Werror -I. -o reader soilbus.c tests/dbc/reader.c
 */
#include "soilbus.h"

#include <stdint.h>

uint8_t soilbus_checksum(uint32_t id, const uint8_t payload[8])
{
    uint8_t bytes[11] = {(uint8_t)id, (uint8_t)(id >> 8), (uint8_t)(id >> 16), (uint8_t)(id >> 24)};
    uint8_t crc = 0xFF;
    for (int i = 0; i < 7; i++)
        bytes[4 + i] = payload[i];
    for (int i = 0; i < 11; i++) {
        crc ^= bytes[i];
        for (int bit = 0; bit < 8; bit++)
            crc = (uint8_t)((crc & 0x80) ? (crc << 1) ^ 0x1D : crc << 1);
    }
    return crc ^ 0xFF;
}

#include <inttypes.h>
#include <stdbool.h>
#include <stdio.h>
#include <string.h>

#define SECOND_SENDER_US 3000000
enum { UNKNOWN, NO_GO, CAUTION, GO, IN_A_ROW = 5 };

/* A frame of ours by its id and cycle, and what a reader remembers of it: all zero before the first one. */
struct stream {
    uint32_t id;
    int64_t cycle_us;
    bool heard;
    uint8_t last[8]; /* the last good one */
    int64_t heard_us, distrusted_until_us;
    unsigned in_a_row; /* good ones, each with the next counter; of the last five: */
    unsigned state[IN_A_ROW];
    int64_t came_us[IN_A_ROW];
};

static unsigned state_of(const uint8_t payload[8])
{
    return (payload[0] & 15) <= GO ? payload[0] & 15 : UNKNOWN; /* error and not available: unknown */
}

static bool is_fresh(const struct stream *s, int64_t now_us)
{
    return s->heard && now_us - s->heard_us <= 3 * s->cycle_us && now_us >= s->distrusted_until_us;
}

/* Takes a frame; NULL where it is good, else what is wrong with it. */
static const char *take(struct stream *s, int64_t now_us, const uint8_t *payload, size_t length)
{
    if (length != 8)
        return "wrong_length";
    if (soilbus_checksum(s->id, payload) != payload[7])
        return "wrong_checksum";
    unsigned step = ((payload[6] >> 4) - (s->last[6] >> 4)) & 15u;
    if (s->heard && step == 0) {
        if (memcmp(payload, s->last, 8) == 0)
            return "repeated";
        s->distrusted_until_us = now_us + SECOND_SENDER_US;
        s->in_a_row = 0;
        return "second_sender";
    }
    if (!s->heard || step != 1 || now_us - s->heard_us > 3 * s->cycle_us) {
        s->in_a_row = 0;
    } else {
        s->state[s->in_a_row % IN_A_ROW] = state_of(payload);
        s->came_us[s->in_a_row++ % IN_A_ROW] = now_us;
    }
    s->heard = true;
    s->heard_us = now_us;
    memcpy(s->last, payload, 8);
    return NULL;
}

/* The state of Traversability to show now. */
static unsigned shown(const struct stream *s, int64_t now_us)
{
    unsigned least = state_of(s->last);
    if (!is_fresh(s, now_us))
        return UNKNOWN;
    if (least <= NO_GO)
        return least; /* at once */
    if (s->in_a_row < IN_A_ROW || s->heard_us - s->came_us[s->in_a_row % IN_A_ROW] < 2 * s->cycle_us)
        return UNKNOWN;
    for (int i = 0; i < IN_A_ROW; i++)
        if (s->state[i] < least)
            least = s->state[i];
    return least;
}

/* The largest draft here and now [N]; false where there is none to act on. */
static bool max_draft(const uint8_t payload[8], double *newtons)
{
    struct soilbus_traction_limits_t in;
    if (soilbus_traction_limits_unpack(&in, payload, 8) != 0)
        return false;
    if (in.status != SOILBUS_TRACTION_LIMITS_STATUS_VALID_CHOICE)
        return false;
    if (!soilbus_traction_limits_max_draft_is_in_range(in.max_draft))
        return false;
    *newtons = soilbus_traction_limits_max_draft_decode(in.max_draft);
    return true;
}

static void print_value(bool is_value, bool is_error, bool is_not_available, double value)
{
    if (is_value)
        printf(" %.17g", value);
    else
        printf(" %s", is_error ? "error" : is_not_available ? "not_available" : "reserved");
}

#define VALUE(frame, signal, CODES)                                                                       \
    print_value(soilbus_##frame##_##signal##_is_in_range(in.signal), in.signal == CODES##_ERROR_CHOICE, \
                in.signal == CODES##_NOT_AVAILABLE_CHOICE, soilbus_##frame##_##signal##_decode(in.signal))

static void print_traversability(const uint8_t payload[8])
{
    struct soilbus_traversability_t in;
    if (soilbus_traversability_unpack(&in, payload, 8) != 0)
        return;
    VALUE(traversability, state, SOILBUS_TRAVERSABILITY_STATE);
    VALUE(traversability, limiting_cause, SOILBUS_TRAVERSABILITY_LIMITING_CAUSE);
    VALUE(traversability, probability, SOILBUS_TRAVERSABILITY_PROBABILITY);
    VALUE(traversability, age, SOILBUS_TRAVERSABILITY_AGE);
    VALUE(traversability, since_valid, SOILBUS_TRAVERSABILITY_SINCE_VALID);
    VALUE(traversability, window, SOILBUS_TRAVERSABILITY_WINDOW);
}

static void print_wheel_slip(const uint8_t payload[8])
{
    struct soilbus_wheel_slip_t in;
    if (soilbus_wheel_slip_unpack(&in, payload, 8) != 0)
        return;
    VALUE(wheel_slip, slip_wheel1, SOILBUS_WHEEL_SLIP_SLIP_WHEEL1);
    VALUE(wheel_slip, slip_wheel2, SOILBUS_WHEEL_SLIP_SLIP_WHEEL2);
    VALUE(wheel_slip, slip_wheel3, SOILBUS_WHEEL_SLIP_SLIP_WHEEL3);
    VALUE(wheel_slip, slip_wheel4, SOILBUS_WHEEL_SLIP_SLIP_WHEEL4);
}

static void print_traction_limits(const uint8_t payload[8])
{
    double newtons;
    if (max_draft(payload, &newtons))
        printf(" %.17g", newtons);
    else
        printf(" none");
}

#define STREAM(FRAME) {.id = FRAME##_FRAME_ID, .cycle_us = 1000 * (int64_t)FRAME##_CYCLE_TIME_MS}

static struct {
    const char *name;
    void (*print)(const uint8_t payload[8]);
    struct stream stream;
    bool said_stale;
} frames[] = {
    {"Traversability", print_traversability, STREAM(SOILBUS_TRAVERSABILITY), false},
    {"WheelSlip", print_wheel_slip, STREAM(SOILBUS_WHEEL_SLIP), false},
    {"TractionLimits", print_traction_limits, STREAM(SOILBUS_TRACTION_LIMITS), false},
};
enum { FRAMES = sizeof frames / sizeof frames[0] };

static void say_what_is_stale(int64_t now_us)
{
    for (int i = 0; i < FRAMES; i++) {
        const struct stream *stream = &frames[i].stream;
        bool is_stale = stream->heard && now_us - stream->heard_us > 3 * stream->cycle_us;
        if (is_stale && !frames[i].said_stale)
            printf("%s stale\n", frames[i].name);
        frames[i].said_stale = is_stale;
    }
}

static void read_frame(int64_t now_us, uint32_t id, const uint8_t *payload, size_t length)
{
    int i = 0;
    while (i < FRAMES && frames[i].stream.id != id)
        i++;
    if (i == FRAMES) {
        printf("- foreign\n");
        return;
    }
    struct stream *stream = &frames[i].stream;
    unsigned lost = stream->heard ? ((payload[6] >> 4) - (stream->last[6] >> 4) - 1) & 15u : 0;
    const char *fault = take(stream, now_us, payload, length);
    if (fault != NULL) {
        printf("%s %s\n", frames[i].name, fault);
        return;
    }
    printf("%s good %u", frames[i].name, lost);
    frames[i].print(payload);
    printf("\n");
}

int main(void)
{
    static const char *const names[] = {"unknown", "no_go", "caution", "go"};
    unsigned state = UNKNOWN;
    char line[192];
    while (fgets(line, sizeof line, stdin) != NULL) {
        int64_t seconds, micros;
        uint32_t id;
        char hex[17] = "";
        uint8_t payload[8] = {0};
        if (sscanf(line, "(%" SCNd64 ".%6" SCNd64 ") %*s %8" SCNx32 "#%16[0-9A-F]", &seconds, &micros, &id, hex) < 3)
            return 1;
        size_t length = strlen(hex) / 2;
        for (size_t i = 0; i < length; i++)
            sscanf(hex + 2 * i, "%2" SCNx8, &payload[i]);
        int64_t now_us = 1000000 * seconds + micros;
        say_what_is_stale(now_us);
        read_frame(now_us, id, payload, length);
        if (shown(&frames[0].stream, now_us) != state)
            printf("verdict %s\n", names[state = shown(&frames[0].stream, now_us)]);
    }
    return 0;
}
