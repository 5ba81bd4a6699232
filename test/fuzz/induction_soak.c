/* The pure files of the induction unit under the address sanitizer: a long random life, every buffer of exact size.
 * Built and run by test_induction_soak.py.  Says what it did; the sanitizers say if it was wrong. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "guard.h"
#include "oversample.h"
#include "phase.h"

static uint32_t state = 1;

static uint32_t
dice(uint32_t sides)
{
    state = state * 1664525u + 1013904223u;
    return (state >> 8) % sides;
}

struct life {
    struct oversample o;
    struct phase_schedule t;
    struct guard g;
    uint32_t index, clock;
    uint64_t fed, lost, reported, blocks;
};

static void
take(struct life *l, uint8_t finished, const struct oversample_block *b)
{
    if (!finished)
        return;
    l->blocks++;
    l->reported += (uint64_t)b->count + b->discarded + b->lost;
    struct guard_input in = {b->sum, b->count, b->phase, b->min, b->max};
    guard_block(&l->g, &in);
}

static void
half_buffer(struct life *l)
{
    struct oversample_block b;
    uint16_t count = 32, *samples = malloc(count * sizeof(*samples)), done = 0;
    for (uint16_t i = 0; i < count; i++)
        samples[i] = (uint16_t)dice(65536);
    while (done < count) {
        uint16_t run, taken;
        uint16_t phase = phase_run(&l->t, l->index, count - done, &run);
        take(l, oversample_step(&l->o, phase, &b), &b);
        for (; run; run -= taken, done += taken) {
            uint16_t *exact = malloc(run * sizeof(*exact));
            memcpy(exact, samples + done, run * sizeof(*exact));
            take(l, oversample_feed(&l->o, exact, run, l->index, &taken, &b), &b);
            free(exact);
            l->index += taken;
        }
    }
    l->fed += count;
    free(samples);
}

static void
commands(struct life *l)
{
    for (uint32_t i = dice(6); i; i--) {
        struct phase_node *node = malloc(sizeof(*node));
        node->clock = l->clock + dice(4000);
        node->phase = (uint16_t)dice(45001);
        if (!phase_push(&l->t, node, l->clock))
            free(node);
    }
    l->clock += 600 * 32;
    for (struct phase_node *node; (node = phase_pop_due(&l->t, l->clock));) {
        phase_applied(&l->t, l->index + dice(64), node->phase);
        guard_fed(&l->g, l->clock, node->phase);
        free(node);
    }
    guard_lapse(&l->g, l->clock);
    guard_check_silence(&l->g, l->clock);
}

int
main(void)
{
    uint64_t blocks = 0;
    for (uint32_t round = 0; round < 60; round++) {
        struct life l = {.index = dice(2) ? 0u - dice(5000) : 0, .clock = 0u - dice(100000)};
        struct oversample_config config = {
            .y = (uint8_t)(3 + dice(3)), .ema_shift = (uint8_t)dice(9), .settle_samples = (uint16_t)dice(50)};
        oversample_init(&l.o, config);
        phase_init(&l.t, 40000);
        guard_init(&l.g, 4095, 7200000, 216000000);
        for (uint32_t row = 0; row < 20; row++)
            guard_add_row(&l.g, (struct guard_row){(uint16_t)(row * 3000), 0, (uint16_t)dice(65536), (uint8_t)dice(4)});
        for (uint32_t half = 0; half < 400; half++) {
            commands(&l);
            half_buffer(&l);
            if (!dice(50)) {
                struct oversample_block b;
                uint32_t gap = 32 * (1 + dice(4));
                l.lost += gap;
                l.index += gap;
                take(&l, oversample_gap(&l.o, gap, &b), &b);
            }
        }
        if (l.fed + l.lost != l.reported + l.o.count + l.o.discarded + l.o.lost) {
            printf("round %u: samples do not add up\n", round);
            return 1;
        }
        for (struct phase_node *node; (node = phase_pop_due(&l.t, l.clock + INT32_MAX));)
            free(node);
        blocks += l.blocks;
    }
    printf("%llu blocks\n", (unsigned long long)blocks);
    return blocks < 1000;
}
