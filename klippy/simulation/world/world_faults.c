/* What breaks while the machine runs, apart from the plants' own parameters; and what the nozzle does from then on. */
#include "world_internal.h"

#include <dlfcn.h>

static struct world_mcu *mcu_at(struct world *w, int index)
{
    return index >= 0 && index < w->mcu_count ? &w->mcus[index] : NULL;
}

void world_cut_link(struct world *w, int mcu, int down, int up, double until_s)
{
    struct world_mcu *m = mcu_at(w, mcu);
    if (m && down)
        m->down.cut_until_s = until_s;
    if (m && up)
        m->up.cut_until_s = until_s;
}

void world_damage_link(struct world *w, int mcu, double corrupt)
{
    struct world_mcu *m = mcu_at(w, mcu);
    if (m)
        m->down.options.corrupt = m->up.options.corrupt = corrupt;
}

void world_step_clock(struct world *w, int mcu, double ppm)
{
    struct world_mcu *m = mcu_at(w, mcu);
    if (!m)
        return;
    m->clock_base += (w->now_s - m->clock_base_s) * m->clock_hz;
    m->clock_base_s = w->now_s;
    m->clock_hz *= 1.0 + 1e-6 * ppm;
}

int world_stop_adc(struct world *w, int mcu)
{
    uintptr_t address = world_symbol(w, mcu, "sim_mcu_stop_adc");
    if (!address)
        return world_fail(w, "the ADC of an emulated chip cannot be stopped from outside");
    ((void (*)(void))address)();
    return 0;
}

void world_reset_mcu(struct world *w, int mcu)
{
    if (mcu_at(w, mcu))
        world_mcu_reboot(mcu_at(w, mcu));
}

void world_stall_host(struct world *w, double until_s)
{
    w->stalled_until_s = until_s;
}

void world_stick_fan(struct world *w, int fan, double speed)
{
    if (fan >= 0 && fan < w->machine.fan_count) {
        w->machine.fans[fan].stuck = 1;
        w->machine.fans[fan].speed = speed;
    }
}

/* ---- what follows --------------------------------------------------------------------------------- */

int world_watch(struct world *w, int nozzle)
{
    if (w->watch_count == WORLD_WATCHES || nozzle < 0 || nozzle >= w->machine.nozzle_count)
        return world_fail(w, "watch: too many, or no such nozzle");
    const double skin_c = w->machine.nozzles[nozzle].plant.skin_c;
    w->watches[w->watch_count] = (struct world_watch_state){
        .nozzle = nozzle, .start_s = w->now_s, .start_c = skin_c, .peak_c = skin_c, .before_j = w->machine.nozzles[nozzle].plant.metal_j, .commanded_s = -1.0, .off_s = -1.0,
    };
    return w->watch_count++;
}

static double since(const struct world_watch_state *s, double now_s, double before_s, int holds)
{
    return !holds ? -1.0 : before_s < 0.0 ? now_s - s->start_s : before_s;
}

void world_watch_tick(struct world *w)
{
    for (int i = 0; i < w->watch_count; i++) {
        struct world_watch_state *s = &w->watches[i];
        const struct nozzle *n = &w->machine.nozzles[s->nozzle];
        const double target_c = w->channels[WORLD_TARGET_C];
        s->target_c = fmax(s->target_c, target_c);
        s->peak_c = fmax(s->peak_c, n->plant.skin_c);
        s->peak_above_c = fmax(s->peak_above_c, n->plant.skin_c - fmax(s->target_c, s->start_c));
        if (n->phase)
            s->before_j = n->plant.metal_j;
        s->commanded_s = since(s, w->now_s, s->commanded_s, !n->phase);
        s->off_s = since(s, w->now_s, s->off_s, !(plant_phase_in_force(&n->plant) > 0.0) || n->plant.supply_open);
        s->after_j = n->plant.metal_j - s->before_j;
    }
}

int world_watched(const struct world *w, int watch, struct world_watch_state *out)
{
    if (watch < 0 || watch >= w->watch_count)
        return 0;
    *out = w->watches[watch];
    return 1;
}
