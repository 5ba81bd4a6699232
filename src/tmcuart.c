/* The single-wire UART of stepper drivers (TMC2208, TMC2209), made by hand on any pins.
 *
 *     send:     data bit after data bit, bit_time apart, straight from `write` (lowest bit first; the host has put start
 *               and stop bits in)
 *     receive:  wait for the line to fall ──► first sample half a bit later ──► then one every bit_time into `read`
 *
 * With rx_pin = tx_pin the pin is an output while sending and an input afterwards.  A driver that stays silent for
 * REPLY_WAIT_BITS gives an empty answer; the host decides what that means.
 */
#include <string.h>

#include "basecmd.h"
#include "board/gpio.h"
#include "board/irq.h"
#include "board/timer.h"
#include "command.h"
#include "sched.h"

DECL_RESPONSE(response_tmcuart, "tmcuart_response oid=%c read=%*s");

enum {
    DATA_MAX = 10,          /* 8 bytes of a register write with start and stop bits */
    REPLY_WAIT_BITS = 400,  /* a driver may delay its answer by up to 15 * 8 bits */
    LOOKS_A_BIT = 4,        /* looks for the falling edge in a bit time */
    IDLE_BITS = 20,         /* drivers take a longer pause as the start of a new message */
};

enum state { IDLE, SENDING, WAITING, RECEIVING, PAUSING, DONE };

struct tmcuart {
    struct timer timer;
    uint32_t rx_pin, tx_pin;
    struct gpio_out tx;
    struct gpio_in rx;
    uint32_t bit_time;
    uint16_t position, looks_left;  /* position in bits */
    uint8_t state, shared_pin, failed;
    int8_t pull_up;
    uint8_t write_len, read_len;
    uint8_t data[DATA_MAX];
};

static struct task_wake tmcuart_wake;

void
tmcuart_init(void)
{
    sched_check_wake(&tmcuart_wake);
}
DECL_INIT(tmcuart_init);

static void
listen(struct tmcuart *u)
{
    u->rx = gpio_in_setup(u->rx_pin, u->pull_up);
}

static uint8_t
finish(struct tmcuart *u)
{
    u->state = DONE;
    sched_wake_task(&tmcuart_wake);
    return SF_DONE;
}

static uint8_t
send_next(struct tmcuart *u)
{
    if (u->position < u->write_len * 8u) {
        gpio_out_write(u->tx, u->data[u->position / 8] >> (u->position % 8) & 1);
        u->position++;
        u->timer.waketime += u->bit_time;
        return SF_RESCHEDULE;
    }
    gpio_out_write(u->tx, 1);
    if (u->shared_pin)
        listen(u);
    if (!u->read_len) {
        /* the pause that ends the message for the driver */
        u->state = PAUSING;
        u->timer.waketime += IDLE_BITS * u->bit_time;
        return SF_RESCHEDULE;
    }
    memset(u->data, 0, sizeof(u->data));
    u->position = 0;
    u->looks_left = REPLY_WAIT_BITS * LOOKS_A_BIT;
    u->state = WAITING;
    u->timer.waketime += u->bit_time / LOOKS_A_BIT;
    return SF_RESCHEDULE;
}

static uint8_t
wait_for_start(struct tmcuart *u)
{
    if (!gpio_in_read(u->rx)) {
        u->state = RECEIVING;
        u->timer.waketime += u->bit_time / 2 - u->bit_time / LOOKS_A_BIT / 2;
        return SF_RESCHEDULE;
    }
    if (!--u->looks_left) {
        u->failed = 1;
        return finish(u);
    }
    u->timer.waketime += u->bit_time / LOOKS_A_BIT;
    return SF_RESCHEDULE;
}

static uint8_t
receive_next(struct tmcuart *u)
{
    u->data[u->position / 8] |= (uint8_t)(gpio_in_read(u->rx) << (u->position % 8));
    if (++u->position == u->read_len * 8u)
        return finish(u);
    u->timer.waketime += u->bit_time;
    return SF_RESCHEDULE;
}

/* Timer; one bit or look a call.  9000 to 40000 baud; late by half a bit: that message is spoilt, its checksum shows it. */
static uint8_t
tmcuart_event(struct timer *t)
{
    struct tmcuart *u = container_of(t, struct tmcuart, timer);
    switch (u->state) {
    case SENDING:
        return send_next(u);
    case WAITING:
        return wait_for_start(u);
    case RECEIVING:
        return receive_next(u);
    default:
        return finish(u);
    }
}

void
command_config_tmcuart(const struct command_args *args)
{
    struct tmcuart *u = oid_alloc((uint8_t)args->val[0], command_config_tmcuart, sizeof(*u));
    uint32_t rx_pin = args->val[1], tx_pin = args->val[3];
    u->pull_up = (int8_t)args->val[2];
    u->bit_time = args->val[4];
    u->shared_pin = rx_pin == tx_pin;
    u->tx = gpio_out_setup(tx_pin, 1);
    u->rx = gpio_in_setup(rx_pin, u->pull_up);
    u->rx_pin = rx_pin;
    u->tx_pin = tx_pin;
    u->timer.func = tmcuart_event;  /* from here on it may be used */
}
DECL_COMMAND(command_config_tmcuart, "config_tmcuart oid=%c rx_pin=%u pull_up=%c tx_pin=%u bit_time=%u");

/* A command while another is under way is dropped; the host waits for answers before it asks again. */
void
command_tmcuart_send(const struct command_args *args)
{
    struct tmcuart *u = oid_lookup((uint8_t)args->val[0], command_config_tmcuart);
    uint32_t read_len = args->val[1];
    if (args->data_len > DATA_MAX || read_len > DATA_MAX)
        shutdown(SHUTDOWN_TMCUART_SIZE);
    if (u->state != IDLE || !u->timer.func)
        return;
    memcpy(u->data, args->data, args->data_len);
    u->write_len = args->data_len;
    u->read_len = (uint8_t)read_len;
    u->position = 0;
    u->failed = 0;
    u->state = SENDING;
    if (u->shared_pin)
        u->tx = gpio_out_setup(u->tx_pin, 1);
    irqstatus_t flag = irq_save();
    u->timer.waketime = timer_read_time() + timer_from_us(200);
    sched_add_timer(&u->timer);
    irq_restore(flag);
}
DECL_COMMAND(command_tmcuart_send, "tmcuart_send oid=%c write=%*s read=%c");

void
tmcuart_task(void)
{
    uint8_t i;
    struct tmcuart *u;
    if (!sched_check_wake(&tmcuart_wake))
        return;
    foreach_oid(i, u, command_config_tmcuart) {
        if (u->state != DONE)
            continue;
        u->state = IDLE;
        respond(&response_tmcuart, (uint8_t)(i - 1), (unsigned int)(u->failed ? 0 : u->read_len), u->data);
    }
}
DECL_TASK(tmcuart_task);

/* Also used to begin anew when the shutdown is cleared. */
void
tmcuart_shutdown(void)
{
    uint8_t i;
    struct tmcuart *u;
    foreach_oid(i, u, command_config_tmcuart) {
        u->state = IDLE;
        if (!u->timer.func)
            continue;
        if (u->shared_pin)
            listen(u);
        else
            gpio_out_write(u->tx, 1);
    }
}
DECL_SHUTDOWN(tmcuart_shutdown);
