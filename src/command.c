/* The receiver of message blocks, the dispatcher of commands, the sender of responses.
 *
 * Receiver.  Bytes are gathered in `rx.block` and judged as early as they can be: length at the first byte, sequence
 * mark at the second, checksum and sync at the last.
 *
 *            sync byte          block complete and right, its turn ──► dispatch, ack
 *     HUNTING ────────► GATHERING ─ block complete and right, not its turn ──► nak
 *        ▲                   │
 *        └───────────────────┘ anything wrong: look for a sync byte in what was gathered, then in what comes;
 *                              nak once, when it is found
 *
 * Ack and nak are the same thing: an empty block with the sequence number expected next.
 */
#include <stdarg.h>
#include <string.h>

#include "board/console.h"
#include "board/irq.h"
#include "command.h"
#include "flash_data.h"
#include "sched.h"
#include "wire.h"

static struct {
    uint8_t block[BLOCK_SIZE_MAX];
    uint8_t gathered;       /* bytes in block */
    uint8_t hunting;        /* in an error burst, no sync byte seen yet */
    uint8_t next_sequence;  /* 0..15, of the block to be obeyed next */
} rx;

static struct task_wake receive_wake;

void
command_init(void)
{
    memset(&rx, 0, sizeof(rx));
    sched_check_wake(&receive_wake);
}
DECL_INIT(command_init);

void
command_wake(void)
{
    sched_wake_task(&receive_wake);
}

/****************************************************************
 * Sending
 ****************************************************************/

static void
send_ack(void)
{
    uint8_t block[BLOCK_SIZE_MIN];
    console_send(block, wire_seal_block(block, 0, rx.next_sequence));
}

static int32_t
take_number(char type, va_list *args)
{
    if (type == 'w')
        return (int32_t)va_arg(*args, uint32_t);
    if (type == 's')
        return va_arg(*args, int);
    return (int32_t)va_arg(*args, unsigned int);
}

/* Encode the content at `out`; NULL if it passes `limit`. */
static uint8_t *
encode_content(uint8_t *out, const uint8_t *limit, const struct response *in_flash, va_list *args)
{
    struct response r;
    char type;
    flash_copy(&r, in_flash, sizeof(r));
    out = wire_put_vlq(out, r.id);
    for (; (type = (char)flash_byte(r.types)); r.types++) {
        if (type != 'b') {
            if (limit - out < VLQ_SIZE_MAX)
                return NULL;
            out = wire_put_vlq(out, take_number(type, args));
            continue;
        }
        unsigned int len = va_arg(*args, unsigned int);
        const uint8_t *data = va_arg(*args, const uint8_t *);
        if (limit - out < 1 || len > (unsigned int)(limit - out - 1))
            return NULL;
        *out++ = (uint8_t)len;
        memcpy(out, data, len);
        out += len;
    }
    return out;
}

void
respond(const struct response *r, ...)
{
    /* Room for a last number of full length beyond the limit is not needed: encode_content checks first.  The check is
     * pessimistic by up to four bytes, so the scratch is longer than a block and the true length is judged after. */
    uint8_t block[BLOCK_SIZE_MAX + VLQ_SIZE_MAX];
    uint8_t *content = block + BLOCK_HEADER_SIZE;
    va_list args;
    va_start(args, r);
    const uint8_t *end = encode_content(content, content + BLOCK_CONTENT_MAX + VLQ_SIZE_MAX - 1, r, &args);
    va_end(args);
    if (!end || end - content > BLOCK_CONTENT_MAX)
        shutdown(SHUTDOWN_MESSAGE_ENCODE);
    console_send(block, wire_seal_block(block, (uint8_t)(end - content), rx.next_sequence));
}

/****************************************************************
 * Dispatching
 ****************************************************************/

/* Decode one command's parameters from [at, end); returns one past the last, NULL if they are malformed. */
static const uint8_t *
decode_parameters(const struct command *c, const uint8_t *at, const uint8_t *end, struct command_args *args)
{
    uint8_t number = 0;
    args->data = NULL;
    args->data_len = 0;
    for (uint8_t i = 0; i < c->param_count; i++) {
        if (i != c->buffer_param) {
            int32_t value;
            at = wire_get_vlq(at, end, &value);
            if (!at)
                return NULL;
            args->val[number++] = (uint32_t)value;
            continue;
        }
        if (at >= end || *at > end - at - 1)
            return NULL;
        args->data_len = *at++;
        args->data = at;
        at += args->data_len;
    }
    return at;
}

static void
dispatch(const uint8_t *at, const uint8_t *end)
{
    while (at < end) {
        int32_t id;
        struct command_args args;
        at = wire_get_vlq(at, end, &id);
        if (!at)
            shutdown(SHUTDOWN_COMMAND_PARSER);
        if (id < 1 || id > (int32_t)command_count)
            shutdown(SHUTDOWN_INVALID_COMMAND);
        struct command c;
        flash_copy(&c, &command_table[id - 1], sizeof(c));
        at = decode_parameters(&c, at, end, &args);
        if (!at)
            shutdown(SHUTDOWN_COMMAND_PARSER);
        if (sched_is_shutdown() && !(c.flags & HF_IN_SHUTDOWN))
            sched_respond_shutdown();
        else
            c.handler(&args);
    }
}

/****************************************************************
 * Receiving
 ****************************************************************/

/* Drop what was gathered up to and including its first sync byte; the rest may be the beginning of a block. */
static void
drop_to_sync(void)
{
    const uint8_t *sync = memchr(rx.block, BLOCK_SYNC, rx.gathered);
    if (!sync) {
        rx.hunting = 1;
        rx.gathered = 0;
        return;
    }
    uint8_t dropped = (uint8_t)(sync + 1 - rx.block);
    rx.hunting = 0;
    rx.gathered -= dropped;
    memmove(rx.block, sync + 1, rx.gathered);
    send_ack();
}

/* A sound block.  It is taken out of `rx` first and the sequence moves on before the commands run, so that their responses
 * acknowledge it, and a shutdown within (which does not return here, and so sends no ack) neither loses the bytes behind
 * it nor makes it run twice. */
static void
obey_block(void)
{
    uint8_t block[BLOCK_SIZE_MAX];
    uint8_t len = rx.block[0];
    memcpy(block, rx.block, len);
    rx.gathered -= len;
    memmove(rx.block, rx.block + len, rx.gathered);
    if ((block[1] & BLOCK_SEQ_MASK) == rx.next_sequence) {
        rx.next_sequence = (rx.next_sequence + 1) & BLOCK_SEQ_MASK;
        dispatch(block + BLOCK_HEADER_SIZE, block + len - BLOCK_TRAILER_SIZE);
    }
    send_ack();
}

enum verdict { INCOMPLETE, SOUND, BROKEN };

static enum verdict
judge_block(void)
{
    uint8_t len = rx.block[0];
    if (len < BLOCK_SIZE_MIN || len > BLOCK_SIZE_MAX)
        return BROKEN;
    if (rx.gathered > 1 && (rx.block[1] & ~BLOCK_SEQ_MASK) != BLOCK_SEQ_MARK)
        return BROKEN;
    if (rx.gathered < len)
        return INCOMPLETE;
    uint8_t checked_len = len - BLOCK_TRAILER_SIZE;
    const uint8_t *trailer = rx.block + checked_len;
    uint16_t crc = wire_crc16(rx.block, checked_len);
    if (trailer[0] != crc >> 8 || trailer[1] != (crc & 0xff) || trailer[2] != BLOCK_SYNC)
        return BROKEN;
    return SOUND;
}

/* Each round takes something away, so this ends.  What drop_to_sync() leaves may hold whole blocks. */
static void
digest(void)
{
    while (rx.gathered) {
        if (rx.block[0] == BLOCK_SYNC) {  /* allowed, once or often, before a block */
            rx.gathered--;
            memmove(rx.block, rx.block + 1, rx.gathered);
            continue;
        }
        enum verdict verdict = judge_block();
        if (verdict == INCOMPLETE)
            return;
        if (verdict == SOUND)
            obey_block();
        else
            drop_to_sync();
    }
}

void
command_task(void)
{
    uint8_t byte;
    sched_check_wake(&receive_wake);
    while (console_read(&byte)) {
        if (!rx.hunting) {
            rx.block[rx.gathered++] = byte;
            /* In the middle of a block it can only be incomplete.  A command that shut down left digest() by a jump:
             * what was gathered behind it has not been judged yet, and its first byte may be no length at all. */
            if (rx.gathered <= BLOCK_HEADER_SIZE || rx.gathered >= rx.block[0] || rx.block[0] > BLOCK_SIZE_MAX)
                digest();
        } else if (byte == BLOCK_SYNC) {
            rx.hunting = 0;
            send_ack();
        }
    }
}
DECL_TASK(command_task);
