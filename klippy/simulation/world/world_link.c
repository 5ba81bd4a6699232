/* Lines with speed, latency and damage; see world_link.h. */
#include "world_link.h"

#include <math.h>
#include <string.h>

uint64_t random_bits(uint64_t *state)
{
    uint64_t z = (*state += 0x9e3779b97f4a7c15u);
    z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
    z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
    return z ^ (z >> 31);
}

double random_uniform(uint64_t *state)
{
    return (double)(random_bits(state) >> 11) * 0x1p-53;
}

void link_init(struct link *l, const struct world_link_options *options, uint64_t seed)
{
    memset(l, 0, sizeof *l);
    l->options = *options;
    l->byte_s = options->baud > 0.0 ? 10.0 / options->baud : 0.0; /* start, 8 data and stop bit */
    l->random = seed;
}

/* Copy `length` bytes into the chunk, each with its chance of an accident. */
static void damage(struct link *l, struct link_chunk *c, const uint8_t *data, uint32_t length)
{
    const struct world_link_options *o = &l->options;
    c->length = 0;
    for (uint32_t i = 0; i < length; i++) {
        uint8_t byte = data[i];
        double chance = random_uniform(&l->random);
        if (chance < o->drop) {
            l->dropped++;
            continue;
        }
        chance -= o->drop;
        if (chance >= 0.0 && chance < o->corrupt) {
            byte ^= (uint8_t)(1u << (random_bits(&l->random) & 7u));
            l->corrupted++;
        }
        chance -= o->corrupt;
        c->data[c->length++] = byte;
        if (chance >= 0.0 && chance < o->duplicate) {
            c->data[c->length++] = byte;
            l->duplicated++;
        }
    }
}

static void send_chunk(struct link *l, const uint8_t *data, uint32_t length, double now_s)
{
    const struct world_link_options *o = &l->options;
    if (l->count == LINK_CHUNKS) {
        l->overflowed++;
        return;
    }
    struct link_chunk *c = &l->chunks[(l->first + l->count) % LINK_CHUNKS];
    if (o->corrupt > 0.0 || o->drop > 0.0 || o->duplicate > 0.0) {
        damage(l, c, data, length);
    } else {
        memcpy(c->data, data, length);
        c->length = length;
    }
    l->free_s = fmax(l->free_s, now_s) + length * l->byte_s;
    double delay = o->latency_s;
    if (o->jitter_s > 0.0)
        delay += o->jitter_s * random_uniform(&l->random);
    c->arrival_s = l->latest_s = fmax(l->latest_s, l->free_s + delay);
    l->count++;
}

void link_send(struct link *l, const uint8_t *data, uint32_t length, double now_s)
{
    l->bytes += length;
    if (now_s < l->cut_until_s) {
        l->dropped += length;
        return;
    }
    while (length) {
        uint32_t part = length < LINK_CHUNK_BYTES ? length : LINK_CHUNK_BYTES;
        send_chunk(l, data, part, now_s);
        data += part;
        length -= part;
    }
}

double link_next_s(const struct link *l)
{
    return l->count ? l->chunks[l->first].arrival_s : INFINITY;
}

const struct link_chunk *link_take(struct link *l, double now_s)
{
    if (!l->count || l->chunks[l->first].arrival_s > now_s)
        return NULL;
    const struct link_chunk *c = &l->chunks[l->first];
    l->first = (l->first + 1) % LINK_CHUNKS;
    l->count--;
    return c; /* stays valid until the ring comes round: LINK_CHUNKS more sends */
}

void link_clear(struct link *l)
{
    l->first = l->count = 0;
}
