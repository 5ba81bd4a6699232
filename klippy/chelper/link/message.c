// Storage of single commands; encoding and decoding of parameters.

#include "message.h"
#include <stdio.h>
#include <stdlib.h>

struct queue_message *
message_alloc(void)
{
    struct queue_message *m = malloc(sizeof(*m));
    if (!m) {
        fputs("chelper: out of memory for MCU messages\n", stderr);
        abort();
    }
    m->next = NULL;
    m->len = 0;
    m->min_clock = m->req_clock = m->notify_id = 0;
    return m;
}

void
message_free(struct queue_message *m)
{
    free(m);
}

void
message_free_list(struct queue_message *list)
{
    while (list) {
        struct queue_message *next = list->next;
        free(list);
        list = next;
    }
}

uint8_t *
vlq_encode(uint8_t *p, int64_t value)
{
    // n groups of 7 bits hold -2^(7n-2) .. 3*2^(7n-2)-1: a first group of 0x60..0x7f means negative
    int groups = 1;
    for (int64_t reach = 1 << 5; groups < 5 && (value < -reach || value >= 3 * reach); reach <<= 7)
        groups++;
    for (int shift = 7 * (groups - 1); shift > 0; shift -= 7)
        *p++ = (uint8_t)(0x80 | ((value >> shift) & 0x7f));
    *p++ = (uint8_t)(value & 0x7f);
    return p;
}

// One number, as far as 32 bits go. Returns the position after it or MESSAGE_CUT_NUMBER.
static int
vlq_decode(const uint8_t *data, int len, int pos, uint32_t *value)
{
    if (pos >= len)
        return MESSAGE_CUT_NUMBER;
    uint32_t v = data[pos] & 0x7f;
    if (v >= 0x60)
        v -= 0x80;
    while (data[pos] & 0x80) {
        if (++pos >= len)
            return MESSAGE_CUT_NUMBER;
        v = v << 7 | (data[pos] & 0x7f);
    }
    *value = v;
    return pos + 1;
}

int
message_decode(const uint8_t *data, int len, int pos, const char *kinds, int64_t *values)
{
    for (int i = 0; kinds[i]; i++) {
        if (kinds[i] == MESSAGE_BUFFER) {
            if (pos >= len || pos + 1 + data[pos] > len)
                return MESSAGE_CUT_BUFFER - i;
            values[i] = (int64_t)(pos + 1) << 8 | data[pos];
            pos += 1 + data[pos];
            continue;
        }
        uint32_t value;
        pos = vlq_decode(data, len, pos, &value);
        if (pos < 0)
            return pos;
        values[i] = kinds[i] == MESSAGE_SIGNED ? (int64_t)(int32_t)value : (int64_t)value;
    }
    return pos;
}

// As it goes over the wire: registers of 32 bits wrap, narrower ones must fit. Returns -1 where it does not.
static int
wire_value(char kind, int64_t *value)
{
    switch (kind) {
    case MESSAGE_UNSIGNED:
        *value = (int64_t)(uint32_t)*value;
        return 0;
    case MESSAGE_SIGNED:
        *value = (int64_t)(int32_t)(uint32_t)*value;
        return 0;
    case MESSAGE_BYTE:
        return *value < -128 || *value > 255 ? -1 : 0;
    case MESSAGE_U16:
        return *value < 0 || *value > 65535 ? -1 : 0;
    case MESSAGE_I16:
        return *value < -32768 || *value > 32767 ? -1 : 0;
    }
    return -1;
}

int
message_encode(const char *kinds, const int64_t *values, uint8_t *out)
{
    uint8_t *p = out;
    for (int i = 0; kinds[i]; i++) {
        int64_t value = values[i];
        if (wire_value(kinds[i], &value))
            return -1;
        p = vlq_encode(p, value);
    }
    return (int)(p - out);
}
