/* What a dashboard ECU does with our frames, by the rules of dbc/README.md: a candump log in, a line a frame out,
 *
 *     <message> good <lost frames> <value or code of each signal>...
 *     <message> wrong_length | wrong_checksum | repeated | stale
 *     - foreign
 *
 * The layouts are the C source that cantools makes of soilbus.dbc; frames.inc lists them (test_reader.py writes it);
 * soilbus_checksum is the README's own.
 */
#include <inttypes.h>
#include <stdbool.h>
#include <stdio.h>
#include <string.h>

#include "soilbus.h"

uint8_t soilbus_checksum(uint32_t id, const uint8_t payload[8]);

enum { PAYLOAD = 8, COUNTERS = 16, CYCLES_UNTIL_STALE = 3 };

static void print_value(bool is_value, bool is_error, bool is_not_available, double value)
{
    if (is_value)
        printf(" %.17g", value);
    else
        printf(" %s", is_error ? "error" : is_not_available ? "not_available" : "reserved");
}

#define VALUE(frame, signal, CODES)                                                                       \
    print_value(soilbus_##frame##_##signal##_is_in_range(in.signal), in.signal == CODES##_ERROR_CHOICE, \
                in.signal == CODES##_NOT_AVAILABLE_CHOICE, soilbus_##frame##_##signal##_decode(in.signal));

#define FRAME(frame, FRAME_, values)                         \
    static void print_##frame(const uint8_t *payload)        \
    {                                                        \
        struct soilbus_##frame##_t in;                       \
        if (soilbus_##frame##_unpack(&in, payload, PAYLOAD)) \
            return;                                          \
        values                                               \
    }
#include "frames.inc"
#undef FRAME

/* One message of ours and what was last heard of it. */
struct stream {
    const char *name;
    uint32_t id;
    int64_t cycle_us;
    void (*print)(const uint8_t *payload);
    bool heard, fresh;
    uint8_t counter;
    int64_t good_us;
};

#define FRAME(frame, FRAME_, values)                                          \
    {.name = FRAME_##_NAME,                                                   \
     .id = FRAME_##_FRAME_ID,                                                 \
     .cycle_us = 1000 * (int64_t)FRAME_##_CYCLE_TIME_MS,                      \
     .print = print_##frame},
static struct stream streams[] = {
#include "frames.inc"
};
static const size_t stream_count = sizeof streams / sizeof streams[0];

static uint8_t counter_of(const uint8_t payload[PAYLOAD])
{
    return payload[6] >> 4;
}

/* NULL where the frame is good, else what is wrong with it.  A repeated counter is not forgiven after a silence
 * either: a sender that is stuck must stay unknown, and one that started anew loses one frame in sixteen starts. */
static const char *fault_of(const struct stream *stream, const uint8_t *payload, size_t length)
{
    if (length != PAYLOAD)
        return "wrong_length";
    if (soilbus_checksum(stream->id, payload) != payload[7])
        return "wrong_checksum";
    if (stream->heard && counter_of(payload) == stream->counter)
        return "repeated";
    return NULL;
}

static void take(struct stream *stream, int64_t now_us, const uint8_t *payload, size_t length)
{
    const char *fault = fault_of(stream, payload, length);
    if (fault != NULL) {
        printf("%s %s\n", stream->name, fault);
        return;
    }
    uint8_t counter = counter_of(payload);
    int lost = stream->heard ? (counter - stream->counter - 1 + COUNTERS) % COUNTERS : 0;
    stream->heard = stream->fresh = true;
    stream->counter = counter;
    stream->good_us = now_us;
    printf("%s good %d", stream->name, lost);
    stream->print(payload);
    printf("\n");
}

static void forget_the_stale(int64_t now_us)
{
    for (size_t i = 0; i < stream_count; i++) {
        struct stream *stream = &streams[i];
        if (stream->fresh && now_us - stream->good_us > CYCLES_UNTIL_STALE * stream->cycle_us) {
            stream->fresh = false;
            printf("%s stale\n", stream->name);
        }
    }
}

static struct stream *stream_of(const char *id_text)
{
    uint32_t id;
    if (sscanf(id_text, "%" SCNx32, &id) == 1)
        for (size_t i = 0; i < stream_count; i++)
            if (streams[i].id == id)
                return &streams[i];
    return NULL;
}

int main(void)
{
    char line[128];
    while (fgets(line, sizeof line, stdin) != NULL) {
        int64_t seconds, micros;
        char id_text[9], hex[2 * PAYLOAD + 1] = "";
        if (sscanf(line, "(%" SCNd64 ".%6" SCNd64 ") %*s %8[0-9A-F]#%16[0-9A-F]", &seconds, &micros, id_text, hex) < 3)
            return 1;
        uint8_t payload[PAYLOAD];
        size_t length = strlen(hex) / 2;
        for (size_t i = 0; i < length; i++)
            if (sscanf(hex + 2 * i, "%2" SCNx8, &payload[i]) != 1)
                return 1;
        int64_t now_us = 1000000 * seconds + micros;
        forget_the_stale(now_us);
        struct stream *stream = stream_of(id_text);
        if (stream == NULL)
            printf("- foreign\n");
        else
            take(stream, now_us, payload, length);
    }
    return 0;
}
