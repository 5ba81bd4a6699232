// Storage and encoding of single commands.

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
