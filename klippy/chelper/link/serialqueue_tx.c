// The sending half of a serialqueue: from command queues over the draft to blocks, and when they go (again).

#include "serialqueue_internal.h"
#include <string.h>

/****************************************************************
 * Clocks
 ****************************************************************/

// MCU clock at host time `when`; UINT64_MAX (everything is due) while clocks are unknown.
static uint64_t
clock_at(const struct serialqueue *sq, double when)
{
    if (!sq->est_freq)
        return UINT64_MAX;
    double clock = (double)sq->est_clock + (when - sq->est_time) * sq->est_freq;
    return clock > 0.0 ? (uint64_t)clock : 0;
}

static double
time_of(const struct serialqueue *sq, uint64_t clock)
{
    return sq->est_time + ((double)clock - (double)sq->est_clock) / sq->est_freq;
}

/****************************************************************
 * Contents: putting messages together
 ****************************************************************/

static int
content_takes(const struct content *c, const struct queue_message *m)
{
    return c->len + m->len <= MESSAGE_CONTENT_MAX && !(m->notify_id && c->notify_count == NOTIFY_MAX);
}

static void
content_append(struct content *c, const struct queue_message *m)
{
    if (!c->len || m->req_clock < c->req_clock)
        c->req_clock = m->req_clock;
    memcpy(c->data + c->len, m->data, (size_t)m->len);
    c->len += m->len;
    c->message_count++;
    if (m->notify_id)
        c->notify[c->notify_count++] = m->notify_id;
}

static void
content_clear(struct content *c)
{
    c->len = c->notify_count = c->message_count = 0;
}

/****************************************************************
 * Command queues
 ****************************************************************/

static struct queue_message *
queue_take(struct serialqueue *sq, struct command_queue *cq)
{
    struct queue_message *m = cq->first;
    cq->first = m->next;
    cq->bytes -= (uint64_t)m->len;
    if (!cq->first) {
        struct command_queue **link = &sq->active;
        while (*link != cq)
            link = &(*link)->next_active;
        *link = cq->next_active;
        cq->is_active = 0;
    }
    return m;
}

// The queue whose head goes next, or NULL; *blocked_until gets the earliest min_clock among those that must wait.
static struct command_queue *
queue_pick(const struct serialqueue *sq, uint64_t now_clock, uint64_t *blocked_until)
{
    struct command_queue *best = NULL;
    for (struct command_queue *cq = sq->active; cq; cq = cq->next_active) {
        const struct queue_message *head = cq->first;
        if (head->min_clock > now_clock) {
            if (head->min_clock < *blocked_until)
                *blocked_until = head->min_clock;
            continue;
        }
        if (!best || head->req_clock < best->first->req_clock
            || (head->req_clock == best->first->req_clock && cq->number < best->number))
            best = cq;
    }
    return best;
}

/****************************************************************
 * File mode: blocks go to a growing buffer
 ****************************************************************/

void
sq_file_end_block(struct serialqueue *sq)
{
    struct file_buffer *f = &sq->file;
    if (!sq->draft.len)
        return;
    if (f->start == f->end)
        f->start = f->end = 0;
    if (f->capacity - f->end < MSGBLOCK_MAX) {
        f->capacity = f->capacity ? 2 * f->capacity : 1 << 16;
        f->data = sq_checked_alloc(f->data, f->capacity);
    }
    f->end += (size_t)msgblock_build(f->data + f->end, sq->send_seq, sq->draft.data, sq->draft.len);
    sq->send_seq++;
    sq->stats.blocks_sent++;
    sq->stats.messages_sent += (uint64_t)sq->draft.message_count;
    content_clear(&sq->draft);
}

void
sq_file_append(struct serialqueue *sq, const struct queue_message *m)
{
    if (!content_takes(&sq->draft, m))
        sq_file_end_block(sq);
    content_append(&sq->draft, m);
    sq->draft.notify_count = 0; // no acknowledgement will come
}

static int
file_transmit(struct serialqueue *sq, uint8_t *out, int capacity)
{
    struct file_buffer *f = &sq->file;
    size_t n = f->end - f->start;
    if (n > (size_t)capacity)
        n = (size_t)capacity;
    if (n)
        memcpy(out, f->data + f->start, n);
    f->start += n;
    sq->stats.bytes_write += n;
    return (int)n;
}

/****************************************************************
 * The window
 ****************************************************************/

int
sq_block_length(const struct content *c)
{
    return MSGBLOCK_HEAD + c->len + MSGBLOCK_TAIL;
}

static int
window_takes(const struct serialqueue *sq, int block_len)
{
    if (sq->send_seq - sq->ack_seq >= WINDOW_BLOCKS)
        return 0;
    return !sq->receive_window || sq->send_seq == sq->ack_seq || sq->unacked_bytes + block_len <= sq->receive_window;
}

// Whether the draft should go out by itself, without waiting for more commands.
static int
draft_is_urgent(const struct serialqueue *sq, uint64_t lead_clock)
{
    const struct content *d = &sq->draft;
    if (!d->len)
        return 0;
    return d->req_clock <= lead_clock || (d->req_clock >= MESSAGE_BACKGROUND_CLOCK && sq->send_seq == sq->ack_seq);
}

// Move commands into the draft. Returns true if it is full: the next command has no room.
static int
draft_fill(struct serialqueue *sq, uint64_t now_clock, uint64_t *blocked_until)
{
    struct command_queue *cq;
    while ((cq = queue_pick(sq, now_clock, blocked_until))) {
        if (!content_takes(&sq->draft, cq->first))
            return 1;
        struct queue_message *m = queue_take(sq, cq);
        content_append(&sq->draft, m);
        message_free(m);
    }
    return sq->draft.len == MESSAGE_CONTENT_MAX;
}

static void
draft_to_window(struct serialqueue *sq)
{
    struct tx_block *b = &sq->window[sq->send_seq % WINDOW_SLOTS];
    b->content = sq->draft;
    b->times_sent = 0;
    b->sent_time = 0.0;
    sq->unacked_bytes += sq_block_length(&b->content);
    sq->send_seq++;
    sq->stats.blocks_sent++;
    sq->stats.messages_sent += (uint64_t)b->content.message_count;
    content_clear(&sq->draft);
}

// Make as many new blocks as are due and as the window takes. Returns the time at which to look again.
static double
make_blocks(struct serialqueue *sq, double now)
{
    uint64_t now_clock = clock_at(sq, now - MIN_CLOCK_GUARD_S), lead_clock = clock_at(sq, now + LEAD_TIME_S);
    for (;;) {
        uint64_t blocked_until = UINT64_MAX;
        int full = draft_fill(sq, now_clock, &blocked_until);
        int due = full || draft_is_urgent(sq, lead_clock);
        if (due && window_takes(sq, sq_block_length(&sq->draft))) {
            draft_to_window(sq);
            continue;
        }
        double wake = SERIALQUEUE_NEVER;
        if (due || !sq->est_freq)
            return wake; // an acknowledgement will bring us back
        if (blocked_until != UINT64_MAX)
            wake = time_of(sq, blocked_until) + MIN_CLOCK_GUARD_S;
        if (sq->draft.len && sq->draft.req_clock < MESSAGE_BACKGROUND_CLOCK) {
            double lead = time_of(sq, sq->draft.req_clock) - LEAD_TIME_S;
            wake = lead < wake ? lead : wake;
        }
        // rounding must not make a caller spin at the same instant
        return wake > now + 1e-6 ? wake : now + 1e-6;
    }
}

// Put everything from next_tx on the wire as far as `out` has room.
static int
emit_blocks(struct serialqueue *sq, uint8_t *out, int capacity, double now)
{
    int used = 0;
    while (sq->next_tx != sq->send_seq) {
        struct tx_block *b = &sq->window[sq->next_tx % WINDOW_SLOTS];
        int need = sq_block_length(&b->content) + sq->sync_first;
        if (used + need > capacity)
            break;
        if (sq->sync_first)
            out[used++] = MSGBLOCK_SYNC;
        sq->sync_first = 0;
        used += msgblock_build(out + used, sq->next_tx, b->content.data, b->content.len);
        if (sq->wire_free_time < now)
            sq->wire_free_time = now;
        sq->wire_free_time += need * sq->byte_time;
        b->sent_time = sq->wire_free_time;
        if (b->times_sent++)
            sq->stats.bytes_retransmit += (uint64_t)need;
        sq->next_tx++;
    }
    sq->stats.bytes_write += (uint64_t)used;
    return used;
}

void
sq_go_back(struct serialqueue *sq)
{
    sq->next_tx = sq->ack_seq;
    sq->resent_from = sq->ack_seq;
    sq->resent_to = sq->send_seq;
    sq->sync_first = 1;
    sq->resends++;
    sq->stats.retransmit_seq = sq->send_seq;
}

static double
rto_deadline(const struct serialqueue *sq)
{
    if (sq->ack_seq == sq->next_tx)
        return SERIALQUEUE_NEVER; // nothing on the wire
    double from = sq->window[sq->ack_seq % WINDOW_SLOTS].sent_time;
    if (from < sq->progress_time)
        from = sq->progress_time;
    return from + sq->rto.rto_s;
}

static int
transmit_locked(struct serialqueue *sq, uint8_t *out, int capacity, double now, double *next_wake)
{
    if (sq->file_mode) {
        *next_wake = SERIALQUEUE_NEVER;
        return file_transmit(sq, out, capacity);
    }
    if (now >= rto_deadline(sq)) {
        rtoclock_backoff(&sq->rto);
        sq->stats.timeouts++;
        sq_go_back(sq);
    }
    double wake = make_blocks(sq, now);
    int used = emit_blocks(sq, out, capacity, now);
    if (sq->next_tx != sq->send_seq)
        wake = now; // `out` was too small
    double deadline = rto_deadline(sq);
    *next_wake = deadline < wake ? deadline : wake;
    return used;
}

int
serialqueue_transmit(struct serialqueue *sq, uint8_t *out, int capacity, double now, double *next_wake)
{
    pthread_mutex_lock(&sq->lock);
    int used = transmit_locked(sq, out, capacity, now, next_wake);
    pthread_mutex_unlock(&sq->lock);
    return used;
}
