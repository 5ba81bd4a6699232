/* The chip as a simulated MCU: the processor's loop, interrupts, reset, counters. */
#include "chip.h"

#include <simavr/sim_core.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>

enum {
    OPCODE_WDR = 0x95a8,
    ENTRY_CYCLES = 5,        /* of an interrupt, with a 22-bit program counter: datasheet 7.8.1; simavr takes none */
    PAINT = 0xa5,            /* RAM after power-on holds anything but zero */
    WORDS = 128 * 1024,
    WDRF = 1 << 3, BORF = 1 << 2, PORF = 1 << 0,
};

avr_t *chip;
struct sim_board board;
struct emulator_counters counters;

static struct {
    int loaded, powered, faulted, reset_asked;
    uint8_t reset_flag;                 /* MCUSR of the reset that is asked for; 0: power on */
    char text[400];
    uint64_t base;                      /* the world's clock at cycle 0 */
    int depth;                          /* interrupts being served */
    uint64_t entered[64];               /* at what cycle, by depth */
    uint64_t own[64];                   /* instructions of each, without what preempted it */
    int vector[64];
    uint64_t busy_ticks, interrupt_ticks;
    uint32_t profile[WORDS];            /* instructions by address */
    write_fn write[REG_LAST + 1];
    read_fn read[REG_LAST + 1];
    struct line {
        avr_int_vector_t avr;
        int (*level)(void);
        void (*taken)(void);
        uint64_t since;
    } lines[VECTOR_COUNT];
} me;

void
chip_fault(const char *format, ...)
{
    if (me.faulted)
        return;
    me.faulted = 1;
    int n = snprintf(me.text, sizeof me.text, "The emulated ATmega2560 objects: ");
    va_list args;
    va_start(args, format);
    n += vsnprintf(me.text + n, sizeof me.text - (size_t)n, format, args);
    va_end(args);
    if (chip && n < (int)sizeof me.text)
        snprintf(me.text + n, sizeof me.text - (size_t)n, " (at 0x%05x)", (unsigned)chip->pc);
}

uint64_t
chip_clock(void)
{
    return me.base + chip->cycle;
}

/****************************************************************
 * Registers
 ****************************************************************/

static void
dispatch_write(avr_t *avr, avr_io_addr_t address, uint8_t value, void *param)
{
    (void)avr;
    (void)param;
    me.write[address](address, value);
}

static uint8_t
dispatch_read(avr_t *avr, avr_io_addr_t address, void *param)
{
    (void)avr;
    (void)param;
    return me.read[address](address);
}

void
on_write(uint16_t address, write_fn fn)
{
    me.write[address] = fn;
    chip->io[address - 32].w.c = dispatch_write;
    chip->io[address - 32].w.param = NULL;
}

void
on_read(uint16_t address, read_fn fn)
{
    me.read[address] = fn;
    chip->io[address - 32].r.c = dispatch_read;
    chip->io[address - 32].r.param = NULL;
}

void
write_plain(uint16_t address, uint8_t value)
{
    chip->data[address] = value;
}

static void
write_unknown(uint16_t address, uint8_t value)
{
    chip_fault("0x%02x is written to register 0x%03x, which the model does not have", value, address);
}

void
need_power(uint16_t prr, uint8_t bit, const char *name)
{
    if (chip->data[prr] & 1 << bit)
        chip_fault("the %s is used while its power is off (PRR)", name);
}

static void
write_mcusr(uint16_t address, uint8_t value)
{
    chip->data[address] &= value; /* flags can only be cleared */
}

static void
install_registers(void)
{
    /* The processor's own stay simavr's. */
    static const uint16_t plain[] = { REG_ACSR, REG_SMCR, REG_PRR0, REG_PRR1, REG_DIDR0, REG_DIDR2, 0x3e, 0x4a, 0x4b };
    static const uint16_t untouched[] = { REG_RAMPZ, REG_EIND, REG_SPL, REG_SPH, REG_SREG };
    for (uint16_t address = 32; address <= REG_LAST; address++) {
        int keep = 0;
        for (unsigned i = 0; i < sizeof untouched / sizeof untouched[0]; i++)
            keep |= address == untouched[i];
        if (keep)
            continue;
        on_write(address, write_unknown);
        chip->io[address - 32].r.c = NULL;
    }
    for (unsigned i = 0; i < sizeof plain / sizeof plain[0]; i++)
        on_write(plain[i], write_plain);
    on_write(REG_MCUSR, write_mcusr);
    pins_init();
    pwm_init();
    timer5_init();
    usart_init();
    analog_init();
    spi_init();
    twi_init();
    watchdog_init();
}

/****************************************************************
 * Interrupt requests and events
 ****************************************************************/

/* simavr looks at an enable bit in a register; level() has looked at the true one, so it gets one that is always set: the
 * I/O space's address 0x3f of SREG's neighbour would be a lie, hence a byte of the reserved area. */
enum { ALWAYS_SET = 0x1ff };

void
request(int vector, int (*level)(void), void (*taken)(void))
{
    struct line *l = &me.lines[vector];
    memset(l, 0, sizeof *l);
    l->level = level;
    l->taken = taken;
    l->avr.vector = (uint8_t)vector;
    l->avr.enable = (avr_regbit_t){ .reg = ALWAYS_SET, .bit = 0, .mask = 1 };
}

void
request_check(int vector)
{
    struct line *l = &me.lines[vector];
    int high = l->level();
    if (high && !l->avr.pending) {
        l->since = chip->cycle;
        avr_raise_interrupt(chip, &l->avr);
    } else if (!high && l->avr.pending) {
        avr_clear_interrupt(chip, &l->avr);
    }
}

void
after(uint64_t cycles, avr_cycle_timer_t fn)
{
    avr_cycle_timer_cancel(chip, fn, NULL);
    avr_cycle_timer_register(chip, cycles ? cycles : 1, fn, NULL);
}

/****************************************************************
 * The processor
 ****************************************************************/

static void
entered_interrupt(void)
{
    int vector = chip->interrupts.running[chip->interrupts.running_ptr - 1]->vector;
    chip->cycle += ENTRY_CYCLES;
    if (me.depth >= 63) {
        chip_fault("interrupts are nested without end");
        return;
    }
    me.vector[me.depth] = vector;
    me.entered[me.depth] = chip->cycle;
    me.own[me.depth] = 0;
    me.depth++;
    counters.interrupts++;
    counters.count[vector]++;
    struct line *l = &me.lines[vector];
    uint64_t waited = chip->cycle - l->since;
    if (waited > counters.worst_latency_ticks)
        counters.worst_latency_ticks = (uint32_t)waited;
    if (l->taken)
        l->taken();
    if (l->level)
        request_check(vector);
}

static void
left_interrupt(void)
{
    me.depth--;
    int vector = me.vector[me.depth];
    uint64_t ticks = chip->cycle - me.entered[me.depth];
    if (ticks > counters.longest_ticks[vector])
        counters.longest_ticks[vector] = (uint32_t)ticks;
    if (me.own[me.depth] > counters.longest_instructions[vector])
        counters.longest_instructions[vector] = (uint32_t)me.own[me.depth];
}

static void
look_at_stack(void)
{
    uint32_t low = (uint32_t)(chip->data[REG_SPL] | chip->data[REG_SPH] << 8) + 1u;
    if (low < counters.stack_low && low > RAM_START)
        counters.stack_low = low;
    if (low <= counters.stack_limit && counters.stack_limit && low > RAM_START)
        chip_fault("the stack has grown out of its space, down to 0x%04x", low);
}

static void
one_instruction(void)
{
    uint64_t before = chip->cycle;
    if (chip->pc > chip->flashend) {
        chip_fault("the processor has stopped: a jump out of the program");
        return;
    }
    me.profile[(chip->pc >> 1) % WORDS]++;
    counters.instructions++;
    if (me.depth) {
        counters.interrupt_instructions++;
        counters.spent[me.vector[me.depth - 1]]++;
        me.own[me.depth - 1]++;
    }
    if ((chip->flash[chip->pc] | chip->flash[chip->pc + 1] << 8) == OPCODE_WDR)
        watchdog_fed();
    chip->run_cycle_count = 1;
    chip->pc = avr_run_one(chip);
    /* After sei and reti one instruction is executed before any interrupt (datasheet 7.8); simavr lets two. */
    if (chip->interrupt_state < -1)
        chip->interrupt_state = -1;
    me.busy_ticks += chip->cycle - before;
    if (me.depth)
        me.interrupt_ticks += chip->cycle - before;
    if (chip->interrupts.running_ptr < me.depth)
        left_interrupt();
    look_at_stack();
}

void
chip_watchdog_reset(void)
{
    me.reset_asked = 1;
    me.reset_flag = WDRF;
    counters.resets++;
}

static void
hear_simavr(avr_t *avr, const int level, const char *format, va_list args)
{
    if (avr != chip || level != LOG_ERROR)
        return;
    char text[200];
    vsnprintf(text, sizeof text, format, args);
    text[strcspn(text, "\n")] = 0;
    if (!strstr(text, "crashed")) /* that shows in the processor's state */
        chip_fault("%s", text);
}

/* simavr reports to one function of the process; another chip's may have been unloaded since. */
static void
listen(void)
{
    avr_global_logger_set(hear_simavr);
}

static void
sleep_until(uint64_t target)
{
    uint64_t next = chip->cycle_timers.timer ? chip->cycle_timers.timer->when : target;
    uint64_t wake = next < target ? next : target;
    if (wake <= chip->cycle)
        return;
    counters.idle_ticks += wake - chip->cycle;
    chip->cycle = wake;
}

static void
run_to(uint64_t target)
{
    while (!me.faulted && !me.reset_asked) {
        if (chip->state == cpu_Running)
            one_instruction();
        else if (chip->state == cpu_Sleeping)
            sleep_until(target);
        else
            chip_fault("the processor has stopped: a wrong instruction, or a jump out of the program");
        avr_cycle_timer_process(chip);
        if (chip->interrupt_state) {
            avr_service_interrupts(chip);
            if (chip->interrupts.running_ptr > me.depth)
                entered_interrupt();
        }
        /* asleep at the target: what is due then has been done */
        if (chip->cycle >= target)
            return;
    }
}

/****************************************************************
 * sim_mcu.h
 ****************************************************************/

void
sim_mcu_boot(const struct sim_board *outside, uint64_t clock)
{
    board = *outside;
    if (!me.loaded) {
        chip_fault("no image has been loaded");
        return;
    }
    listen();
    avr_reset(chip);
    for (int i = 0; i < VECTOR_COUNT; i++)
        me.lines[i].avr.pending = 0;
    chip->cycle = 0;
    memset(chip->data + 32, 0, RAM_START - 32); /* simavr's own peripherals have left marks */
    chip->data[REG_SPL] = RAM_END & 0xff;
    chip->data[REG_SPH] = RAM_END >> 8;
    chip->data[ALWAYS_SET] = 1;
    chip->interrupts.running_ptr = 0;
    me.depth = 0;
    me.base = clock;
    if (!me.reset_flag)
        memset(chip->data + RAM_START, PAINT, RAM_END + 1 - RAM_START);
    chip->data[REG_MCUSR] = me.reset_flag ? me.reset_flag : PORF;
    pins_reset();
    pwm_reset();
    timer5_reset();
    usart_reset();
    analog_reset();
    spi_reset();
    twi_reset();
    watchdog_reset(me.reset_flag == WDRF);
    me.powered = 1;
    me.reset_asked = me.reset_flag = 0;
}

uint64_t
sim_mcu_next_event(void)
{
    if (!me.powered || me.faulted || me.reset_asked)
        return UINT64_MAX;
    if (chip->state == cpu_Sleeping && !chip->interrupt_state)
        return chip->cycle_timers.timer ? me.base + chip->cycle_timers.timer->when : UINT64_MAX;
    return chip_clock();
}

void
sim_mcu_advance(uint64_t clock)
{
    if (!me.powered || me.faulted || me.reset_asked || clock <= chip_clock())
        return;
    listen();
    uint64_t before = chip->cycle;
    run_to(clock - me.base);
    counters.ticks += chip->cycle - before;
}

void
sim_mcu_receive(const uint8_t *data, uint32_t len)
{
    if (!me.powered || me.faulted || me.reset_asked)
        return;
    listen();
    usart_receive(data, len);
}

int
sim_mcu_take_reset(void)
{
    int asked = me.reset_asked && me.powered;
    if (asked)
        me.powered = 0;
    return asked;
}

/****************************************************************
 * emulator.h
 ****************************************************************/

const char *
emulator_load(const char *elf_path)
{
    if (!chip) {
        listen();
        chip = avr_make_mcu_by_name("atmega2560");
        if (!chip)
            return "this libsimavr does not know the ATmega2560";
        avr_init(chip);
        chip->frequency = CLOCK_HZ;
        chip->run_cycle_limit = 1;
        install_registers();
    }
    const char *error = image_load(elf_path, chip->flash, chip->flashend + 1);
    if (error)
        return error;
    uint32_t limit, ignored;
    memset(&counters, 0, sizeof counters);
    memset(me.profile, 0, sizeof me.profile);
    counters.stack_top = counters.stack_low = RAM_END + 1;
    if (!image_symbol("stack_limit", &limit, &ignored))
        counters.stack_limit = limit & 0xffff;
    chip->codeend = chip->flashend;
    me.busy_ticks = me.interrupt_ticks = 0;
    me.loaded = 1;
    me.powered = me.faulted = 0;
    return NULL;
}

int
emulator_fault(char *text, int size)
{
    if (me.faulted && size > 0)
        snprintf(text, (size_t)size, "%s", me.text);
    return me.faulted;
}

void
emulator_counters(struct emulator_counters *out)
{
    *out = counters;
}

int
emulator_mutate(const char *what, uint32_t value)
{
    if (strcmp(what, "brown_out") || !me.powered)
        return -1;
    /* Below the level of the fuse (Arduino: 2.7 V) the chip is held in reset; memory may have survived. */
    me.reset_asked = value != 0;
    me.reset_flag = value ? BORF : 0;
    return 0;
}

int
emulator_peek(const char *what, uint32_t *value)
{
    uint32_t address, size;
    if (!strcmp(what, "ticks.busy"))
        *value = (uint32_t)me.busy_ticks;
    else if (!strcmp(what, "ticks.interrupt"))
        *value = (uint32_t)me.interrupt_ticks;
    else if (!strcmp(what, "timer5.zero"))
        *value = (uint32_t)(me.base + timer5_zero());
    else if (what[0] == '=' && !image_symbol(what + 1, &address, &size) && (address & 0xffff) <= RAM_END - 3u)
        memcpy(value, chip->data + (address & 0xffff), sizeof *value);
    else
        return -1;
    return 0;
}

int64_t
emulator_profile(const char *symbol)
{
    uint32_t address, size;
    if (image_symbol(symbol, &address, &size) || address + size > WORDS * 2)
        return -1;
    int64_t sum = 0;
    for (uint32_t word = address / 2; word < (address + size) / 2; word++)
        sum += me.profile[word];
    return sum;
}
