#ifndef CHELPER_SERIALQUEUE_H
#define CHELPER_SERIALQUEUE_H
// The host's end of one MCU link, without any I/O: bytes and the time go in, bytes and the next wake-up come out.
//
//   host (any thread)                                             port (its own thread, or the simulated world)
//   serialqueue_send ──► command_queue ─┐
//   serialqueue_send ──► command_queue ─┼─► draft block ─► unacked blocks ──► serialqueue_transmit ──► wire
//   steppersync      ──► command_queue ─┘                      ▲ acks                                   │
//   serialqueue_pull ◄── received messages ◄────┐                                                       │
//   serialqueue_pull_batch ◄── those of a batch ◄─┴────────── serialqueue_receive ◄───────────────────────┘
//
// Every function may be called from any thread; one mutex guards the whole. Times are seconds of the one host clock
// that the port uses (CLOCK_MONOTONIC, or virtual time). Clocks are 64-bit MCU ticks.

#include <stdint.h>
#include "message.h"

struct serialqueue;
struct command_queue; // commands that must stay in order among themselves

#define SERIALQUEUE_NEVER 1e30 // next_wake when only something new can give work

enum {
    SERIALQUEUE_TRANSMIT_MIN = 1024, // a capacity that always takes a whole retransmission
};

// One thing for the host: a message of the MCU (len > 0), or the notice that a command was acknowledged (len 0).
struct pull_message {
    int len;
    uint8_t data[64];    // content of the block: VLQ id and parameters
    double sent_time;    // when the newest acknowledged block had left the host; 0 if unknown (it was sent twice)
    double receive_time; // when this block began to arrive by the wire's speed
    uint64_t notify_id;  // of the acknowledged command; 0 for a message
};

struct serialqueue_stats {
    uint64_t bytes_write, bytes_read, bytes_retransmit, bytes_invalid;
    uint64_t send_seq, receive_seq, retransmit_seq; // extended block sequence numbers
    uint64_t messages_sent, blocks_sent, timeouts;
    uint64_t ready_bytes, upcoming_bytes, unacked_bytes; // in the draft; in the queues; in the window
    uint32_t unacked_blocks;
    double srtt, rttvar, rto; // seconds, RFC 6298
};

struct serialqueue *serialqueue_alloc(int file_mode); // file_mode: no MCU listens, all goes straight out
void serialqueue_free(struct serialqueue *sq);
// A new connection: drops all that is queued and received, forgets clock and wire. No port may be attached.
void serialqueue_reset(struct serialqueue *sq, int file_mode);
struct command_queue *serialqueue_alloc_commandqueue(struct serialqueue *sq); // lives as long as sq

// --- host side
// Queue one encoded command (1..59 bytes). Returns 0, or -1 if the length is impossible.
int serialqueue_send(struct serialqueue *sq, struct command_queue *cq, const uint8_t *data, int len,
                     uint64_t min_clock, uint64_t req_clock, uint64_t notify_id);
// Queue a list of messages (linked by next, NULL at the end, in order); takes ownership. Returns their number,
// or -1 (and queues none of the rest) at an impossible length.
int serialqueue_send_batch(struct serialqueue *sq, struct command_queue *cq, struct queue_message *list);
int serialqueue_pull(struct serialqueue *sq, struct pull_message *out, int max); // returns how many were taken
// Messages that begin with these bytes (their id, 1..4 of them) wait for serialqueue_pull_batch, apart from the others,
// until there are batch_max of them or the oldest is patience_s old. batch_max 0: none waits. id_len 0: no batches.
void serialqueue_set_batch(struct serialqueue *sq, const uint8_t *id, int id_len, double patience_s, int batch_max);
// Messages that begin with these bytes wake nobody and wait for serialqueue_pull_patient. id_len 0: there are none.
void serialqueue_set_patient(struct serialqueue *sq, const uint8_t *id, int id_len);
// Takes the waiting batch, in order, if it is due by now; returns how many messages.
int serialqueue_pull_batch(struct serialqueue *sq, struct pull_message *out, int max, double now);
// The oldest of them, each behind its length in one byte; returns how many bytes.
int serialqueue_pull_patient(struct serialqueue *sq, uint8_t *out, int max);
// Host time `conv_time` is MCU clock `conv_clock`, and the MCU does `freq` ticks a second of host time.
// freq 0 (the start): clocks unknown, everything is sent at once.
void serialqueue_set_clock_est(struct serialqueue *sq, double freq, double conv_time, uint64_t conv_clock);
void serialqueue_set_wire(struct serialqueue *sq, double bits_per_second, int receive_window); // 0 = no such limit
void serialqueue_get_stats(struct serialqueue *sq, struct serialqueue_stats *out);
// file_mode: bytes of finished blocks waiting; `finish` ends the block that is being filled
uint64_t serialqueue_file_pending(struct serialqueue *sq, int finish);

// --- port side
// Returns how many messages wait that the host should look at now.
int serialqueue_receive(struct serialqueue *sq, const uint8_t *data, int len, double now);
// When the host must have looked at what waits for it: 0 at once, SERIALQUEUE_NEVER if nothing does.
double serialqueue_host_due(struct serialqueue *sq);
int serialqueue_transmit(struct serialqueue *sq, uint8_t *out, int capacity, double now, double *next_wake);

#endif
