// The receiving half of a serialqueue: blocks, acknowledgements, and messages for the host.

#include "serialqueue_internal.h"
#include <stdlib.h>
#include <string.h>

static int
begins_with(const struct pull_message *message, const uint8_t *id, int id_len)
{
    return id_len && message->len >= id_len && !memcmp(message->data, id, (size_t)id_len);
}

static void
deliver(struct serialqueue *sq, const struct pull_message *message)
{
    struct rx_node *node = sq_checked_alloc(NULL, sizeof(*node));
    node->message = *message;
    node->next = NULL;
    struct rx_list *list = begins_with(message, sq->batch_id, sq->batch_id_len)       ? &sq->batch
                           : begins_with(message, sq->patient_id, sq->patient_id_len) ? &sq->patient
                                                                                      : &sq->received;
    if (list->first)
        list->last->next = node;
    else
        list->first = node;
    list->last = node;
    list->count++;
}

static void
acknowledge_oldest(struct serialqueue *sq, double now)
{
    struct tx_block *b = &sq->window[sq->ack_seq % WINDOW_SLOTS];
    sq->ack_sent_time = b->times_sent == 1 ? b->sent_time : 0.0;
    sq->unacked_bytes -= sq_block_length(&b->content);
    for (int i = 0; i < b->content.notify_count; i++) {
        struct pull_message notice = {
            .sent_time = sq->ack_sent_time, .receive_time = now, .notify_id = b->content.notify[i]};
        deliver(sq, &notice);
    }
    sq->ack_seq++;
}

// The MCU expects `acked` next: all before it has arrived.
static void
take_progress(struct serialqueue *sq, uint64_t acked, double now)
{
    while (sq->ack_seq != acked)
        acknowledge_oldest(sq, now);
    if (sq->next_tx < acked)
        sq->next_tx = acked; // a retransmission in preparation turned out needless
    sq->progress_time = now;
    if (sq->ack_sent_time)
        rtoclock_sample(&sq->rto, now > sq->ack_sent_time ? now - sq->ack_sent_time : 0.0);
    else
        rtoclock_progress(&sq->rto);
}

// The MCU stands at a sequence that we never reached: continue from there (only while nothing is settled).
static void
take_numbering(struct serialqueue *sq, uint64_t expected)
{
    struct tx_block old[WINDOW_SLOTS];
    uint64_t count = sq->send_seq - sq->ack_seq;
    memcpy(old, sq->window, sizeof(old));
    for (uint64_t i = 0; i < count; i++)
        sq->window[(expected + i) % WINDOW_SLOTS] = old[(sq->ack_seq + i) % WINDOW_SLOTS];
    sq->ack_seq = expected;
    sq->send_seq = expected + count;
    sq_go_back(sq);
}

// In four bits an acknowledgement of 9..12 blocks looks like a late one, 7..4 blocks old. Acknowledgements come
// one for each block, so such a leap means that many were lost, or that the line reorders. A true one is repeated
// after the next retransmission; a late one is not.
static int
is_doubtful(struct serialqueue *sq, int wire_seq, uint64_t ahead)
{
    if (ahead <= SURE_LEAP) {
        if (ahead)
            sq->doubted_seq = -1;
        return 0;
    }
    if (sq->doubted_seq == wire_seq && sq->resends != sq->doubted_resend) {
        sq->doubted_seq = -1;
        return 0;
    }
    if (sq->doubted_seq != wire_seq) {
        sq->doubted_seq = wire_seq;
        sq->doubted_resend = sq->resends;
    }
    return 1;
}

// After a retransmission the MCU still complains about what was on the wire before it. A complaint that comes when the
// retransmitted block must itself have arrived is news: that one was lost too.
static int
is_echo(const struct serialqueue *sq, double now)
{
    if (sq->ack_seq != sq->resent_from && sq->ack_seq != sq->resent_to)
        return 0;
    double arrived = sq->window[sq->ack_seq % WINDOW_SLOTS].sent_time + 0.5 * sq->rto.srtt_s;
    return !sq->rto.has_sample || now < arrived;
}

static void
take_sequence(struct serialqueue *sq, int wire_seq, int is_empty, double now)
{
    uint64_t ahead = ((uint64_t)wire_seq - sq->ack_seq) & MSGBLOCK_SEQ_MASK;
    uint64_t expected = sq->ack_seq + ahead;
    if (expected > sq->send_seq) {
        // a late duplicate from before, or (at the start) where the MCU stands
        if (!sq->numbering_settled)
            take_numbering(sq, expected);
        return;
    }
    if (is_doubtful(sq, wire_seq, ahead))
        return;
    int is_duplicate = is_empty && !ahead && sq->last_empty == wire_seq;
    if (is_empty)
        sq->last_empty = wire_seq;
    if (ahead) {
        take_progress(sq, expected, now);
        if (!is_empty)
            sq->numbering_settled = 1;
    } else if (is_duplicate && sq->ack_seq != sq->next_tx && !is_echo(sq, now)) {
        sq_go_back(sq);
    }
}

static void
take_block(struct serialqueue *sq, const uint8_t *block, int len, double now)
{
    int content_len = len - MSGBLOCK_HEAD - MSGBLOCK_TAIL;
    take_sequence(sq, block[1] & MSGBLOCK_SEQ_MASK, !content_len, now);
    if (!content_len)
        return;
    struct pull_message message = {
        .len = content_len, .sent_time = sq->ack_sent_time, .receive_time = now - len * sq->byte_time};
    memcpy(message.data, block + MSGBLOCK_HEAD, (size_t)content_len);
    deliver(sq, &message);
}

// Take whole blocks out of rx; keeps the beginning of an unfinished one.
static void
parse_rx(struct serialqueue *sq, double now)
{
    int pos = 0;
    while (pos < sq->rx_len) {
        int verdict = msgblock_check(sq->rx + pos, sq->rx_len - pos);
        if (!verdict)
            break;
        if (verdict > 0) {
            take_block(sq, sq->rx + pos, verdict, now);
            pos += verdict;
        } else {
            if (sq->rx[pos] != MSGBLOCK_SYNC)
                sq->stats.bytes_invalid += (uint64_t)-verdict;
            pos -= verdict;
        }
    }
    sq->rx_len -= pos;
    memmove(sq->rx, sq->rx + pos, (size_t)sq->rx_len);
}

// When the host gets the batch: 0 at once, SERIALQUEUE_NEVER while it is empty.
static double
batch_due(const struct serialqueue *sq)
{
    if (!sq->batch.count)
        return SERIALQUEUE_NEVER;
    return sq->batch.count >= sq->batch_max ? 0.0 : sq->batch.first->message.receive_time + sq->batch_patience_s;
}

int
serialqueue_receive(struct serialqueue *sq, const uint8_t *data, int len, double now)
{
    pthread_mutex_lock(&sq->lock);
    sq->stats.bytes_read += (uint64_t)len;
    while (len > 0) {
        int room = (int)sizeof(sq->rx) - sq->rx_len; // an unfinished block leaves at least 3/4 of it free
        int part = len < room ? len : room;
        memcpy(sq->rx + sq->rx_len, data, (size_t)part);
        sq->rx_len += part;
        data += part;
        len -= part;
        parse_rx(sq, now);
    }
    int waiting = sq->received.count + (batch_due(sq) <= now ? sq->batch.count : 0);
    pthread_mutex_unlock(&sq->lock);
    return waiting;
}

void
serialqueue_set_batch(struct serialqueue *sq, const uint8_t *id, int id_len, double patience_s, int batch_max)
{
    pthread_mutex_lock(&sq->lock);
    sq->batch_id_len = id_len > 0 && id_len <= (int)sizeof(sq->batch_id) ? id_len : 0;
    memcpy(sq->batch_id, id, (size_t)sq->batch_id_len);
    sq->batch_max = batch_max;
    sq->batch_patience_s = patience_s;
    pthread_mutex_unlock(&sq->lock);
}

void
serialqueue_set_patient(struct serialqueue *sq, const uint8_t *id, int id_len)
{
    pthread_mutex_lock(&sq->lock);
    sq->patient_id_len = id_len > 0 && id_len <= (int)sizeof(sq->patient_id) ? id_len : 0;
    memcpy(sq->patient_id, id, (size_t)sq->patient_id_len);
    pthread_mutex_unlock(&sq->lock);
}

double
serialqueue_host_due(struct serialqueue *sq)
{
    pthread_mutex_lock(&sq->lock);
    double due = sq->received.count ? 0.0 : batch_due(sq);
    pthread_mutex_unlock(&sq->lock);
    return due;
}

static int
pull(struct rx_list *list, struct pull_message *out, int max)
{
    int count = 0;
    while (count < max && list->first) {
        struct rx_node *node = list->first;
        list->first = node->next;
        out[count++] = node->message;
        free(node);
    }
    list->count -= count;
    return count;
}

int
serialqueue_pull(struct serialqueue *sq, struct pull_message *out, int max)
{
    pthread_mutex_lock(&sq->lock);
    int count = pull(&sq->received, out, max);
    pthread_mutex_unlock(&sq->lock);
    return count;
}

int
serialqueue_pull_batch(struct serialqueue *sq, struct pull_message *out, int max, double now)
{
    pthread_mutex_lock(&sq->lock);
    int count = batch_due(sq) <= now ? pull(&sq->batch, out, max) : 0;
    pthread_mutex_unlock(&sq->lock);
    return count;
}

int
serialqueue_pull_patient(struct serialqueue *sq, uint8_t *out, int max)
{
    int used = 0;
    pthread_mutex_lock(&sq->lock);
    struct rx_list *list = &sq->patient;
    while (list->first && used + 1 + list->first->message.len <= max) {
        struct rx_node *node = list->first;
        list->first = node->next;
        out[used++] = (uint8_t)node->message.len;
        memcpy(out + used, node->message.data, (size_t)node->message.len);
        used += node->message.len;
        list->count--;
        free(node);
    }
    pthread_mutex_unlock(&sq->lock);
    return used;
}

static void
drop(struct rx_list *list)
{
    while (list->first) {
        struct rx_node *node = list->first;
        list->first = node->next;
        free(node);
    }
    list->count = 0;
}

void
sq_drop_received(struct serialqueue *sq)
{
    drop(&sq->received);
    drop(&sq->patient);
    drop(&sq->batch);
    sq->rx_len = 0;
}
