#ifndef CHELPER_SERIALQUEUE_INTERNAL_H
#define CHELPER_SERIALQUEUE_INTERNAL_H
// What the three files of serialqueue share. Functions here expect the caller to hold the lock.
//
// The host's end of one MCU link, without I/O (serialqueue.h has the picture).
//
// Sending. Each command_queue is a first-in first-out. Among the queues whose head may be sent (min_clock reached) the
// head that is needed first (req_clock) goes into the draft block. A draft becomes a block when it is full or when its
// earliest command is needed within LEAD_TIME_S; so a busy line carries full blocks and an idle one is prompt.
// Blocks stay in the window until acknowledged: at most WINDOW_BLOCKS, and at most receive_window bytes.
//
// Sequence numbers are kept as 64 bits; the wire carries the low four:
//
//      ack_seq            next_tx             send_seq
//   …───┴── on the wire ─────┴── to be sent ──────┴── not made yet …
//
// Losing. The MCU takes blocks in order only and answers each block with an empty one carrying the sequence it expects
// next. Two empty ones alike mean that it dropped something: everything from ack_seq on is sent again (next_tx goes
// back), after one sync byte that ends whatever garbage its parser is in. Silence for the RTO does the same.
//
// Exactly once: a block is numbered once and never changes its content, and the MCU executes a number only when it is
// the expected one. Only before the first answer may the numbering move (the MCU's first nak says where it stands).


#include <pthread.h>
#include <stddef.h>
#include <stdint.h>
#include "msgblock.h"
#include "rtoclock.h"
#include "serialqueue.h"

enum {
    WINDOW_BLOCKS = 12, // as many as the 4-bit sequence leaves room for, with distance for late duplicates
    WINDOW_SLOTS = 16,
    SURE_LEAP = 8, // an acknowledgement of more blocks at once may be an old one by 16 - that many
    NOTIFY_MAX = 8, // commands in one block that want to know of their acknowledgement
};
#define LEAD_TIME_S 0.100
// A slot of the move queue must be free on arrival although the clock estimate may run ahead of the MCU a little.
#define MIN_CLOCK_GUARD_S 0.001

struct command_queue {
    struct command_queue *next_all, *next_active;
    struct queue_message *first, *last;
    uint64_t bytes;
    int number; // order of creation: decides between equals
    int is_active;
};

struct content {
    uint8_t data[MESSAGE_CONTENT_MAX];
    int len;
    uint64_t req_clock; // the earliest one inside
    uint64_t notify[NOTIFY_MAX];
    int notify_count, message_count;
};

struct tx_block {
    struct content content;
    int times_sent;
    double sent_time; // its last byte has left, by the wire's speed
};

struct rx_node {
    struct rx_node *next;
    struct pull_message message;
};

struct rx_list {
    struct rx_node *first, *last;
    int count;
};

struct file_buffer {
    uint8_t *data;
    size_t start, end, capacity;
};

struct serialqueue {
    pthread_mutex_t lock;
    int file_mode;
    struct command_queue *all, *active;
    int queue_count;
    // clock of the MCU
    double est_freq, est_time;
    uint64_t est_clock;
    // the wire
    double byte_time, wire_free_time;
    int receive_window;
    // sending
    struct content draft;
    struct tx_block window[WINDOW_SLOTS]; // by seq % WINDOW_SLOTS
    uint64_t ack_seq, next_tx, send_seq;
    int unacked_bytes;
    int sync_first;        // begin the next transmission with a sync byte
    int numbering_settled; // the MCU has answered one of our blocks
    int last_empty;        // wire sequence of the last empty block, -1 before one
    uint64_t resent_from;  // ack_seq and send_seq of the last retransmission: their duplicates
    uint64_t resent_to;    //   are echoes of what was sent before it, no news
    int doubted_seq;         // a leap not accepted yet, -1: none
    uint64_t doubted_resend; //   and how often we had sent again by then
    uint64_t resends;
    double progress_time;  // of the last acknowledgement that moved ack_seq
    double ack_sent_time;  // of the newest acknowledged block; 0 if sent twice
    struct rtoclock rto;
    // receiving
    uint8_t rx[4 * MSGBLOCK_MAX];
    int rx_len;
    struct rx_list received, batch, patient; // for serialqueue_pull, serialqueue_pull_batch, serialqueue_pull_patient
    uint8_t batch_id[4];
    int batch_id_len, batch_max;
    double batch_patience_s;
    uint8_t patient_id[4];
    int patient_id_len;
    struct file_buffer file;
    struct serialqueue_stats stats;
};

void *sq_checked_alloc(void *old, size_t size); // realloc that ends the program when memory is out

// serialqueue_tx.c
void sq_file_end_block(struct serialqueue *sq);
void sq_file_append(struct serialqueue *sq, const struct queue_message *m);
void sq_go_back(struct serialqueue *sq); // send everything unacknowledged again
int sq_block_length(const struct content *c);

// serialqueue_rx.c
void sq_drop_received(struct serialqueue *sq);

#endif
