/* The simulated bridge and the ADC in step with it.
 *
 * Period edges lie at base + n * period.  Sample n of the ADC is taken at start + n * period, start being an edge.
 * The world is asked for samples late and many at a time: when a half buffer is full, and before the phase changes, so
 * that all samples of one question lie under one phase:
 *
 *     edges    |    |    |    |    |    |    |    |    |
 *     samples  0    1    2    3    4    5    6    7
 *                     set_phase ^
 *                          edge event: read 0..3 (before the edge), then bridge_set
 *                                            half full at 7: read 4..7, then ready()
 */
#include "board/bridge_pwm.h"
#include "board/sync_adc.h"
#include "command.h"
#include "sched.h"
#include "sim_internal.h"

DECL_CONSTANT("BRIDGE_PHASE_MAX", 45000);

enum { HALF_LEN_MAX = 128, PERIOD_TICKS_MIN = 72, PERIOD_TICKS_MAX = 65535 };

static struct {
    uint32_t period_ticks;       /* 0: not set up */
    uint64_t base_clock;
    uint16_t pending_phase, pending_move, moved;
    uint64_t move_clock;         /* when pending_move comes into force; SIM_NEVER: nothing pending */
    uint64_t edge_clock;         /* when pending_phase comes into force; SIM_NEVER: nothing pending */
    uint16_t half_len;           /* 0: the ADC is not set up */
    sync_adc_ready_fn ready;
    uint64_t start_clock;        /* of sample 0 */
    uint64_t samples_read;       /* from the world */
    uint64_t half_clock;         /* of the last sample of the half buffer being filled; SIM_NEVER: not started */
    uint16_t buffer[2][HALF_LEN_MAX];
} bridge;

void
sim_bridge_init(void)
{
    bridge = (typeof(bridge)){ .move_clock = SIM_NEVER, .edge_clock = SIM_NEVER, .half_clock = SIM_NEVER };
}
DECL_INIT(sim_bridge_init);

static uint64_t
next_edge(void)
{
    return sim_clock + bridge.period_ticks - (sim_clock - bridge.base_clock) % bridge.period_ticks;
}

/* Read the samples of the half buffer under way that lie before `clock`. */
static void
read_samples_before(uint64_t clock)
{
    if (bridge.half_clock == SIM_NEVER || clock <= bridge.start_clock)
        return;
    uint64_t wanted = (clock - 1 - bridge.start_clock) / bridge.period_ticks + 1;
    if (wanted <= bridge.samples_read)
        return;  /* turned off from within the interrupt of the newest sample */
    uint32_t count = (uint32_t)(wanted - bridge.samples_read);
    uint32_t place = (uint32_t)(bridge.samples_read % (2u * bridge.half_len));
    uint64_t first_clock = bridge.start_clock + bridge.samples_read * bridge.period_ticks;
    uint16_t *to = place < bridge.half_len ? &bridge.buffer[0][place] : &bridge.buffer[1][place - bridge.half_len];
    bridge.samples_read = wanted;
    sim_board.sync_adc_read(sim_board.ctx, to, count, first_clock, bridge.period_ticks);
}

void
sim_mcu_stop_adc(void)
{
    bridge.half_clock = SIM_NEVER;
}

static void
send_phase(uint16_t phase)
{
    read_samples_before(sim_clock);
    bridge.edge_clock = SIM_NEVER;
    sim_board.bridge_set(sim_board.ctx, phase, sim_clock);
}

/****************************************************************
 * Board contract
 ****************************************************************/

struct bridge_pwm
bridge_pwm_setup(uint8_t id, uint32_t period_ticks)
{
    if (id)
        shutdown(SHUTDOWN_BRIDGE_ID);
    if (period_ticks < PERIOD_TICKS_MIN || period_ticks > PERIOD_TICKS_MAX)
        shutdown(SHUTDOWN_BRIDGE_PERIOD);
    bridge.period_ticks = period_ticks;
    bridge.base_clock = sim_clock;
    send_phase(0);
    return (struct bridge_pwm){ id };
}

void
bridge_pwm_set_phase(struct bridge_pwm b, uint16_t phase)
{
    (void)b;
    bridge.pending_phase = phase > BRIDGE_PHASE_MAX ? BRIDGE_PHASE_MAX : phase;
    bridge.edge_clock = next_edge();
}

void
bridge_pwm_off(struct bridge_pwm b)
{
    (void)b;
    if (bridge.period_ticks)
        send_phase(0);
}

struct sync_adc
sync_adc_setup(uint32_t pin, struct bridge_pwm b, uint16_t half_len, sync_adc_ready_fn ready)
{
    (void)b;
    if (pin >= SIM_PIN_COUNT)
        shutdown(SHUTDOWN_NOT_ADC_PIN);
    if (!bridge.period_ticks || !half_len || half_len > HALF_LEN_MAX)
        shutdown(SHUTDOWN_SYNC_ADC);
    bridge.half_len = half_len;
    bridge.ready = ready;
    return (struct sync_adc){ 0 };
}

uint32_t
sync_adc_start(struct sync_adc a)
{
    (void)a;
    bridge.start_clock = next_edge();
    bridge.samples_read = 0;
    bridge.half_clock = bridge.start_clock + (uint64_t)(bridge.half_len - 1) * bridge.period_ticks;
    return (uint32_t)bridge.start_clock;
}

uint32_t
sync_adc_position(struct sync_adc a)
{
    (void)a;
    if (bridge.half_clock == SIM_NEVER || sim_clock < bridge.start_clock)
        return 0;
    return (uint32_t)((sim_clock - bridge.start_clock) / bridge.period_ticks) + 1;
}

void
sync_adc_move(struct sync_adc a, uint16_t ticks)
{
    (void)a;
    if (ticks == bridge.moved)
        return;
    bridge.moved = bridge.pending_move = ticks;
    bridge.move_clock = next_edge();
}

/****************************************************************
 * Events
 ****************************************************************/

uint64_t
sim_bridge_next_event(void)
{
    uint64_t edge = bridge.edge_clock < bridge.move_clock ? bridge.edge_clock : bridge.move_clock;
    return edge < bridge.half_clock ? edge : bridge.half_clock;
}

static void
call_ready(void *half)
{
    bridge.ready(half, bridge.half_len);
}

void
sim_bridge_run(void)
{
    if (bridge.move_clock <= sim_clock) {
        read_samples_before(sim_clock);
        bridge.move_clock = SIM_NEVER;
        if (sim_board.sync_adc_move)
            sim_board.sync_adc_move(sim_board.ctx, bridge.pending_move, sim_clock);
    }
    if (bridge.edge_clock <= sim_clock)
        send_phase(bridge.pending_phase);
    if (bridge.half_clock > sim_clock)
        return;
    read_samples_before(sim_clock + 1);
    bridge.half_clock += (uint64_t)bridge.half_len * bridge.period_ticks;
    uint32_t half = (uint32_t)((bridge.samples_read - 1) / bridge.half_len) & 1;
    sched_guarded(call_ready, bridge.buffer[half]);
}
