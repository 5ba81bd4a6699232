/* Theory, formats and contexts: attention.h. */
#include "attention.h"

void
attention_expect(struct attention *a, uint16_t phase, uint32_t sum, uint32_t limit)
{
    a->next = (struct attention_expected){.sum = sum, .phase = phase};
    if (!a->limit || a->now.phase == phase) {
        a->now = a->next;
        a->mean8 = 0;
    }
    a->limit = limit < ATTENTION_LIMIT_MAX ? limit : ATTENTION_LIMIT_MAX;
}

uint8_t
attention_block(struct attention *a, uint16_t phase, uint32_t sum)
{
    if (!a->limit)
        return 0;
    if (phase != a->now.phase) {
        if (phase != a->next.phase)
            return 0;
        a->now = a->next;
        a->mean8 = 0;
    }
    int32_t off = (int32_t)(sum - a->now.sum), most = 8 * (int32_t)a->limit;
    uint8_t far = off > most || off < -most;
    if (!far) {
        a->mean8 += off - (a->mean8 >> 3);
        far = a->mean8 > most || a->mean8 < -most;
    }
    if (far)
        a->limit = 0;
    return far;
}
