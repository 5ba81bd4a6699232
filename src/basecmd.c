#include <string.h>

#include "basecmd.h"
#include "board/irq.h"
#include "board/misc.h"
#include "board/timer.h"
#include "command.h"
#include "flash_data.h"
#include "sched.h"

DECL_RESPONSE(response_config, "config is_config=%c crc=%u is_shutdown=%c move_count=%hu");
DECL_RESPONSE(response_clock, "clock clock=%u");
DECL_RESPONSE(response_uptime, "uptime high=%u clock=%u");
DECL_RESPONSE(response_stats, "stats count=%u sum=%u sumsq=%u");
DECL_RESPONSE(response_identify, "identify_response offset=%u data=%.*s");

enum { STATS_SUMSQ_BASE = 256 };
DECL_CONSTANT("STATS_SUMSQ_BASE", 256);
enum { STATS_PERIOD_US = 5000000, UPTIME_POLL_US = 100000, IDENTIFY_MAX = 50 };

/* Objects of one kind are chained in order of oid: a shutdown walks them all in an interrupt.  The first ones of the kinds
 * hang in a table by the kind's address, so that a kind without objects is seldom looked for.  Chains hold oid + 1; 0 ends them. */
enum { KIND_CHAINS = 8 };

struct oid_slot {
    void *type, *object;
    uint8_t next_alike;
    uint8_t next_kind;  /* in the first of a kind only */
};

static struct {
    char *arena;
    size_t arena_left;
    struct oid_slot *oids;
    uint8_t oid_count, first_kind[KIND_CHAINS];
    uint8_t finalized;
    uint32_t config_crc;
    struct move_node *free_moves;
    char *move_pool;
    uint16_t move_size, move_count;
} pool;

static struct {
    struct timer tick;
    struct task_wake wake;
    uint32_t low, high;                    /* uptime as last seen */
    uint32_t stats_clock;
    uint32_t count, sum, sumsq;
} uptime;

/****************************************************************
 * Memory
 ****************************************************************/

static void *
arena_take(size_t size)
{
    size = (size + sizeof(void *) - 1) & ~(sizeof(void *) - 1);
    if (size > pool.arena_left)
        return NULL;
    void *taken = pool.arena;
    pool.arena += size;
    pool.arena_left -= size;
    memset(taken, 0, size);
    return taken;
}

void *
alloc_chunk(uint16_t size)
{
    if (pool.finalized)
        shutdown(SHUTDOWN_ALREADY_FINALIZED);
    void *chunk = arena_take(size);
    if (!chunk)
        shutdown(SHUTDOWN_ALLOC_CHUNK);
    return chunk;
}

/****************************************************************
 * Object ids
 ****************************************************************/

void
command_allocate_oids(const struct command_args *args)
{
    if (pool.oids)
        shutdown(SHUTDOWN_OIDS_ALLOCATED);
    uint8_t count = (uint8_t)args->val[0];
    pool.oids = alloc_chunk((uint16_t)(count * sizeof(*pool.oids)));
    pool.oid_count = count;
}
DECL_COMMAND(command_allocate_oids, "allocate_oids count=%c");

static struct oid_slot *
slot_of(uint8_t number)
{
    return &pool.oids[number - 1];
}

/* The link that leads to the first object of a kind; the end of its chain, if there is none. */
static uint8_t *
link_of_kind(void *type)
{
    uint8_t *link = &pool.first_kind[(uintptr_t)type >> 2 & (KIND_CHAINS - 1)];
    while (*link && slot_of(*link)->type != type)
        link = &slot_of(*link)->next_kind;
    return link;
}

static void
chain(struct oid_slot *slot, uint8_t number)
{
    uint8_t *link = link_of_kind(slot->type);
    if (*link > number)
        slot->next_kind = slot_of(*link)->next_kind;
    while (*link && *link < number)
        link = &slot_of(*link)->next_alike;
    slot->next_alike = *link;
    *link = number;
}

void *
oid_alloc(uint8_t oid, void *type, uint16_t size)
{
    if (oid >= pool.oid_count || pool.oids[oid].type || pool.finalized)
        shutdown(SHUTDOWN_OID_ASSIGN);
    struct oid_slot *slot = &pool.oids[oid];
    slot->object = alloc_chunk(size);
    slot->type = type;
    chain(slot, (uint8_t)(oid + 1));
    return slot->object;
}

void *
oid_lookup(uint8_t oid, void *type)
{
    if (oid >= pool.oid_count || pool.oids[oid].type != type)
        shutdown(SHUTDOWN_OID_TYPE);
    return pool.oids[oid].object;
}

/* Once in the image: inlined it would stand there two dozen times. */
__attribute__((noinline)) void *
oid_next(uint8_t *cursor, void *type)
{
    uint8_t number = *cursor ? slot_of(*cursor)->next_alike : *link_of_kind(type);
    *cursor = number;
    return number ? slot_of(number)->object : NULL;
}

/****************************************************************
 * Move queue
 ****************************************************************/

void
move_request_size(uint16_t size)
{
    if (pool.finalized || size < sizeof(struct move_node))
        shutdown(SHUTDOWN_MOVE_SIZE);
    if (size > pool.move_size)
        pool.move_size = size;
}

/* All entries back into the pool, in order of address: what follows is the same on every run. */
static void
moves_reset(void)
{
    pool.free_moves = NULL;
    for (uint16_t i = pool.move_count; i--;) {
        struct move_node *node = (void *)(pool.move_pool + (size_t)i * pool.move_size);
        node->next = pool.free_moves;
        pool.free_moves = node;
    }
}

static void
moves_allocate(void)
{
    const size_t unit = sizeof(void *);
    if (pool.move_size < sizeof(struct move_node))
        pool.move_size = sizeof(struct move_node);
    pool.move_size = (uint16_t)((pool.move_size + unit - 1) & ~(unit - 1));
    size_t count = pool.arena_left / pool.move_size;
    if (!count)
        shutdown(SHUTDOWN_ALLOC_CHUNKS);
    pool.move_count = count > PORT_MOVE_COUNT_MAX ? PORT_MOVE_COUNT_MAX : (uint16_t)count;
    pool.move_pool = arena_take((size_t)pool.move_count * pool.move_size);
    moves_reset();
}

void *
move_alloc(void)
{
    irqstatus_t flag = irq_save();
    struct move_node *node = pool.free_moves;
    if (!node)
        shutdown(SHUTDOWN_MOVE_OVERFLOW);
    pool.free_moves = node->next;
    irq_restore(flag);
    return node;
}

void
move_free(void *entry)
{
    struct move_node *node = entry;
    irqstatus_t flag = irq_save();
    node->next = pool.free_moves;
    pool.free_moves = node;
    irq_restore(flag);
}

void
move_queue_init(struct move_queue_head *q)
{
    q->first = NULL;
    q->end = &q->first;
}

void
move_queue_push(struct move_queue_head *q, struct move_node *node)
{
    node->next = NULL;
    *q->end = node;
    q->end = &node->next;
}

struct move_node *
move_queue_pop(struct move_queue_head *q)
{
    struct move_node *node = q->first;
    if (!node)
        return NULL;
    q->first = node->next;
    if (!q->first)
        q->end = &q->first;
    return node;
}

void
move_queue_clear(struct move_queue_head *q)
{
    struct move_node *node;
    while ((node = move_queue_pop(q)))
        move_free(node);
}

/****************************************************************
 * Configuration
 ****************************************************************/

void
command_finalize_config(const struct command_args *args)
{
    if (pool.finalized)
        shutdown(SHUTDOWN_ALREADY_FINALIZED);
    moves_allocate();
    pool.config_crc = args->val[0];
    pool.finalized = 1;
}
DECL_COMMAND(command_finalize_config, "finalize_config crc=%u");

void
command_get_config(const struct command_args *args)
{
    (void)args;
    respond(&response_config, pool.finalized, pool.config_crc, sched_is_shutdown(), pool.move_count);
}
DECL_COMMAND_FLAGS(command_get_config, HF_IN_SHUTDOWN, "get_config");

void
command_identify(const struct command_args *args)
{
    uint32_t offset = args->val[0];
    uint32_t count = args->val[1] & 0xff;
    uint32_t left = offset < identify_size ? identify_size - offset : 0;
    if (count > left)
        count = left;
    if (count > IDENTIFY_MAX)
        count = IDENTIFY_MAX;
    uint8_t part[IDENTIFY_MAX];  /* the dictionary may lie where only this loop can read it */
    for (uint8_t i = 0; i < count; i++)
        part[i] = flash_byte(identify_data + offset + i);
    respond(&response_identify, offset, (unsigned int)count, part);
}
DECL_COMMAND_FLAGS(command_identify, HF_IN_SHUTDOWN, "identify offset=%u count=%c");

/****************************************************************
 * Clock, statistics
 ****************************************************************/

void
command_get_clock(const struct command_args *args)
{
    (void)args;
    respond(&response_clock, timer_read_time());
}
DECL_COMMAND_FLAGS(command_get_clock, HF_IN_SHUTDOWN, "get_clock");

/* Task context, at least once in 2^32 ticks: uptime_tick sees to that. */
static void
uptime_follow(uint32_t clock)
{
    if (clock < uptime.low)
        uptime.high++;
    uptime.low = clock;
}

void
command_get_uptime(const struct command_args *args)
{
    (void)args;
    uptime_follow(timer_read_time());
    respond(&response_uptime, uptime.high, uptime.low);
}
DECL_COMMAND_FLAGS(command_get_uptime, HF_IN_SHUTDOWN, "get_uptime");

/* Also keeps the timer list from being empty, and so the port's compare register from standing still for a wrap. */
static uint8_t
uptime_tick(struct timer *t)
{
    t->waketime += timer_from_us(UPTIME_POLL_US);
    sched_wake_task(&uptime.wake);
    return SF_RESCHEDULE;
}

static void
stats_count_pass(uint32_t spent)
{
    uptime.count++;
    uptime.sum += spent;
    /* sum of squares in units of STATS_SUMSQ_BASE; a pass of 2^16 ticks or more is scaled before it can overflow */
    uptime.sumsq += spent < 0x10000 ? (spent * spent + STATS_SUMSQ_BASE - 1) / STATS_SUMSQ_BASE
                                    : (spent / STATS_SUMSQ_BASE + 1) * spent;
}

/* Once per pass of the main loop: how many passes, how long they took (the one under way not yet), every five seconds to
 * the host.  Sleep between passes is not work. */
void
stats_task(void)
{
    uint32_t clock = timer_read_time();
    stats_count_pass(sched_last_pass_ticks());
    if (!sched_check_wake(&uptime.wake))
        return;
    uptime_follow(clock);
    if (timer_is_before(clock, uptime.stats_clock + timer_from_us(STATS_PERIOD_US)))
        return;
    respond(&response_stats, uptime.count, uptime.sum, uptime.sumsq);
    uptime.stats_clock = clock;
    uptime.count = uptime.sum = uptime.sumsq = 0;
}
DECL_TASK(stats_task);

static void
uptime_restart(void)
{
    uptime.tick.func = uptime_tick;
    uptime.tick.waketime = timer_read_time() + timer_from_us(UPTIME_POLL_US);
    sched_add_timer_always(&uptime.tick);
}

/****************************************************************
 * Stop and go
 ****************************************************************/

void
command_emergency_stop(const struct command_args *args)
{
    (void)args;
    try_shutdown(SHUTDOWN_COMMAND_REQUEST);
}
DECL_COMMAND_FLAGS(command_emergency_stop, HF_IN_SHUTDOWN, "emergency_stop");

void
command_clear_shutdown(const struct command_args *args)
{
    (void)args;
    sched_clear_shutdown();
    moves_reset();
}
DECL_COMMAND_FLAGS(command_clear_shutdown, HF_IN_SHUTDOWN, "clear_shutdown");

void
command_reset(const struct command_args *args)
{
    (void)args;
    board_reset();
}
DECL_COMMAND_FLAGS(command_reset, HF_IN_SHUTDOWN, "reset");

void
basecmd_shutdown(void)
{
    uptime_restart();
}
DECL_SHUTDOWN(basecmd_shutdown);

void
basecmd_init(void)
{
    memset(&pool, 0, sizeof(pool));
    memset(&uptime, 0, sizeof(uptime));
    void *start;
    pool.arena_left = board_arena(&start);
    pool.arena = start;
    uptime.low = uptime.stats_clock = timer_read_time();
    uptime_restart();
}
DECL_INIT(basecmd_init);
