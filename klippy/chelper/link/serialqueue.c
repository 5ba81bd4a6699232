// The host's side of a serialqueue: create it, fill its command queues, query it. serialqueue_internal.h explains how
// the whole works.

#include "serialqueue_internal.h"
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

void *
sq_checked_alloc(void *old, size_t size)
{
    void *p = realloc(old, size);
    if (!p) {
        fputs("chelper: out of memory for the MCU link\n", stderr);
        abort();
    }
    return p;
}

static void
queue_append(struct serialqueue *sq, struct command_queue *cq, struct queue_message *first, struct queue_message *last,
             uint64_t bytes)
{
    if (cq->first)
        cq->last->next = first;
    else
        cq->first = first;
    cq->last = last;
    cq->bytes += bytes;
    if (!cq->is_active) {
        cq->is_active = 1;
        cq->next_active = sq->active;
        sq->active = cq;
    }
}

// Everything as at the start, but the command queues (empty) and the counters stay.
static void
start_over(struct serialqueue *sq, int file_mode)
{
    for (struct command_queue *cq = sq->all; cq; cq = cq->next_all) {
        message_free_list(cq->first);
        cq->first = cq->last = NULL;
        cq->bytes = 0;
        cq->is_active = 0;
    }
    sq->active = NULL;
    sq_drop_received(sq);
    sq->batch_id_len = sq->batch_max = 0;
    sq->patient_id_len = 0;
    memset(&sq->draft, 0, sizeof(sq->draft));
    sq->file.start = sq->file.end = 0;
    sq->file_mode = file_mode;
    sq->est_freq = sq->byte_time = sq->wire_free_time = 0.0;
    sq->receive_window = sq->unacked_bytes = 0;
    sq->ack_seq = sq->next_tx = sq->send_seq = 1;
    sq->numbering_settled = sq->sync_first = 0;
    sq->last_empty = sq->doubted_seq = -1;
    sq->resent_from = sq->resent_to = UINT64_MAX;
    sq->progress_time = sq->ack_sent_time = 0.0;
    rtoclock_init(&sq->rto);
}

struct serialqueue *
serialqueue_alloc(int file_mode)
{
    struct serialqueue *sq = sq_checked_alloc(NULL, sizeof(*sq));
    memset(sq, 0, sizeof(*sq));
    pthread_mutex_init(&sq->lock, NULL);
    start_over(sq, file_mode);
    return sq;
}

void
serialqueue_reset(struct serialqueue *sq, int file_mode)
{
    pthread_mutex_lock(&sq->lock);
    start_over(sq, file_mode);
    pthread_mutex_unlock(&sq->lock);
}

void
serialqueue_free(struct serialqueue *sq)
{
    if (!sq)
        return;
    start_over(sq, 0);
    while (sq->all) {
        struct command_queue *cq = sq->all;
        sq->all = cq->next_all;
        free(cq);
    }
    free(sq->file.data);
    pthread_mutex_destroy(&sq->lock);
    free(sq);
}

struct command_queue *
serialqueue_alloc_commandqueue(struct serialqueue *sq)
{
    struct command_queue *cq = sq_checked_alloc(NULL, sizeof(*cq));
    memset(cq, 0, sizeof(*cq));
    pthread_mutex_lock(&sq->lock);
    cq->number = sq->queue_count++;
    cq->next_all = sq->all;
    sq->all = cq;
    pthread_mutex_unlock(&sq->lock);
    return cq;
}

int
serialqueue_send(struct serialqueue *sq, struct command_queue *cq, const uint8_t *data, int len, uint64_t min_clock,
                 uint64_t req_clock, uint64_t notify_id)
{
    if (len < 1 || len > MESSAGE_CONTENT_MAX)
        return -1;
    struct queue_message *m = message_alloc();
    memcpy(m->data, data, (size_t)len);
    m->len = len;
    m->min_clock = min_clock;
    m->req_clock = req_clock;
    m->notify_id = notify_id;
    return serialqueue_send_batch(sq, cq, m) == 1 ? 0 : -1;
}

int
serialqueue_send_batch(struct serialqueue *sq, struct command_queue *cq, struct queue_message *list)
{
    int count = 0;
    uint64_t bytes = 0;
    struct queue_message *last = NULL;
    for (struct queue_message *m = list; m; last = m, m = m->next) {
        if (m->len < 1 || m->len > MESSAGE_CONTENT_MAX) {
            message_free_list(list);
            return -1;
        }
        bytes += (uint64_t)m->len;
        count++;
    }
    if (!count)
        return 0;
    pthread_mutex_lock(&sq->lock);
    if (sq->file_mode) {
        for (struct queue_message *m = list; m; m = m->next)
            sq_file_append(sq, m);
    } else {
        queue_append(sq, cq, list, last, bytes);
    }
    pthread_mutex_unlock(&sq->lock);
    if (sq->file_mode)
        message_free_list(list);
    return count;
}

void
serialqueue_set_clock_est(struct serialqueue *sq, double freq, double conv_time, uint64_t conv_clock)
{
    pthread_mutex_lock(&sq->lock);
    sq->est_freq = freq;
    sq->est_time = conv_time;
    sq->est_clock = conv_clock;
    pthread_mutex_unlock(&sq->lock);
}

void
serialqueue_set_wire(struct serialqueue *sq, double bits_per_second, int receive_window)
{
    pthread_mutex_lock(&sq->lock);
    // a UART byte is ten bits: start, eight, stop
    sq->byte_time = bits_per_second > 0.0 ? 10.0 / bits_per_second : 0.0;
    sq->receive_window = receive_window;
    pthread_mutex_unlock(&sq->lock);
}

void
serialqueue_get_stats(struct serialqueue *sq, struct serialqueue_stats *out)
{
    pthread_mutex_lock(&sq->lock);
    *out = sq->stats;
    out->send_seq = sq->send_seq;
    out->receive_seq = sq->ack_seq;
    out->unacked_blocks = (uint32_t)(sq->send_seq - sq->ack_seq);
    out->unacked_bytes = (uint64_t)sq->unacked_bytes;
    out->srtt = sq->rto.srtt_s;
    out->rttvar = sq->rto.rttvar_s;
    out->rto = sq->rto.rto_s;
    out->ready_bytes = (uint64_t)sq->draft.len;
    out->upcoming_bytes = 0;
    for (const struct command_queue *cq = sq->active; cq; cq = cq->next_active)
        out->upcoming_bytes += cq->bytes;
    pthread_mutex_unlock(&sq->lock);
}

uint64_t
serialqueue_file_pending(struct serialqueue *sq, int finish)
{
    pthread_mutex_lock(&sq->lock);
    if (finish && sq->file_mode)
        sq_file_end_block(sq);
    uint64_t pending = sq->file.end - sq->file.start;
    pthread_mutex_unlock(&sq->lock);
    return pending;
}
