// Records of one message, and their place in time. See convert.h.

#include "convert.h"
#include "pipeline.h"
#include "chelper/link/message.h"
#include "chelper/link/serialqueue.h"

enum {
    LOW_MASK = 0x0fff,
    HAS_PHASE = 0x1000,
    IS_CUT = 0x2000,
    HAS_GAP = 0x4000,
    IS_WIDE = 0x8000,
    SEQUENCE_MODULUS = 1 << 16,
};

// What is left of a message; `len` < 0: more was asked for than there is.
struct bytes {
    const uint8_t *at;
    int len;
};

static uint32_t
take(struct bytes *b, int size)
{
    b->len -= size;
    if (b->len < 0)
        return 0;
    uint32_t value = 0;
    for (int i = size; i--;)
        value = value << 8 | b->at[i];
    b->at += size;
    return value;
}

// One record; `phase` is that of the record before and of this one. mean_raw holds the sum as sent for now.
static int
take_record(struct bytes *b, int32_t *phase, int32_t whole, struct coil_block *out)
{
    uint32_t first = take(b, 2), span = take(b, 1), value = take(b, 3);
    out->min_raw = first & LOW_MASK;
    out->max_raw = out->min_raw + (int32_t)span;
    out->count = whole;
    out->discarded = out->lost = 0;
    if (first & HAS_PHASE)
        *phase = (int32_t)take(b, 2);
    if (first & IS_CUT)
        out->count = (int32_t)take(b, 2);
    if (first & HAS_GAP) {
        out->discarded = (int32_t)take(b, 2);
        out->lost = (int32_t)take(b, 2);
    }
    if (first & IS_WIDE)
        out->max_raw = (int32_t)take(b, 2);
    out->phase_ticks = *phase;
    out->mean_raw = value;
    if (b->len < 0)
        return BLOCKWIRE_CUT;
    return out->count && *phase >= 0 ? 0 : BLOCKWIRE_SENSELESS;
}

// The 16-bit index extended, what is missing before it counted; -1: older than what was seen, a duplicate.
static int64_t
unwrap(struct block_stream *stream, uint32_t sequence)
{
    if (stream->next_sequence < 0)
        return sequence;
    uint32_t gap = (sequence - (uint32_t)stream->next_sequence) & (SEQUENCE_MODULUS - 1);
    if (gap >= SEQUENCE_MODULUS / 2)
        return -1;
    stream->missing_blocks += gap;
    return stream->next_sequence + gap;
}

// The records of one message; count, or less one of blockwire_error.
static int
take_records(const struct block_stream *stream, struct bytes rest, struct coil_block *out)
{
    int32_t phase = -1;
    int count = 0;
    while (rest.len > 0) {
        int error = count < MESSAGE_BLOCKS_MAX ? take_record(&rest, &phase, stream->block_samples, &out[count])
                                                : BLOCKWIRE_SENSELESS;
        if (error)
            return -error;
        count++;
    }
    return count ? count : -BLOCKWIRE_EMPTY;
}

// Their place in time and sequence; `index` of the first, which lies at the message's clock.
static void
place_records(struct block_stream *stream, struct coil_block *out, int count, int64_t index, int64_t clock,
              double start_s)
{
    double scale = (double)(1 << stream->oversample);
    // The MCU's shift drops the low bits of the sum; on average it drops half of their range.
    double dropped = 0.5 * (scale - 1.0);
    int64_t offset = -(out[0].discarded + out[0].lost);
    for (struct coil_block *b = out; b < out + count; b++) {
        offset += b->discarded + b->lost;
        b->sequence = index++;
        b->clock = clock + offset * stream->period_ticks;
        b->time_s = start_s + (double)offset * stream->period_s;
        b->duration_s = b->count * stream->period_s;
        b->mean_raw = (b->mean_raw * scale + dropped) / b->count;
        offset += b->count;
        stream->lost_samples += b->lost;
        stream->discarded_samples += b->discarded;
    }
    stream->next_sequence = index;
    stream->blocks += count;
}

// induction_block oid=%c sequence=%hu clock=%u data=%*s, behind its id. There is one induction unit to an MCU.
static int
unpack_message(struct block_stream *stream, const struct clock_point *near, const struct pull_message *m,
               struct coil_block *out)
{
    enum { ID, OID, SEQUENCE, CLOCK, DATA, VALUES };
    int64_t v[VALUES];
    if (message_decode(m->data, m->len, 0, "uuuus", v) != m->len)
        return -BLOCKWIRE_CUT;
    struct bytes records = {m->data + (v[DATA] >> 8), (int)(v[DATA] & 0xff)};
    int count = take_records(stream, records, out);
    if (count < 0)
        return count;
    int64_t index = unwrap(stream, (uint32_t)v[SEQUENCE]);
    if (index < 0)
        return 0;
    int32_t since = (int32_t)((uint32_t)v[CLOCK] - (uint32_t)near->clock);
    place_records(stream, out, count, index, near->clock + since, near->time_s + since * near->tick_s);
    return count;
}

int
blockwire_unpack(struct block_stream *stream, const struct clock_point *near, const struct pull_message *messages,
                 int message_count, struct coil_block *out)
{
    int count = 0;
    for (const struct pull_message *m = messages; m < messages + message_count; m++) {
        if (count + MESSAGE_BLOCKS_MAX > BLOCKS_MAX)
            break;
        int got = unpack_message(stream, near, m, out + count);
        if (got < 0) {
            stream->complaint = -got;
            stream->senseless_messages++;
            continue;
        }
        count += got;
    }
    return count;
}
