#ifndef CHELPER_MESSAGE_H
#define CHELPER_MESSAGE_H
// One command on its way to an MCU: already encoded, waiting for its turn.
//
// Whoever makes a message fills `len`, `data` and the two clocks, links messages through `next` and hands the list to
// serialqueue_send_batch(), which then owns (and frees) it.

#include <stdint.h>

enum {
    MESSAGE_DATA_MAX = 64,    // room in struct queue_message; the wire takes at most MESSAGE_CONTENT_MAX of it
    MESSAGE_CONTENT_MAX = 59, // a block of 64 bytes less length, sequence, crc (2) and sync
};

// req_clock of something that may wait until the line has nothing better to do (displays, LEDs)
#define MESSAGE_BACKGROUND_CLOCK 0x7fffffff00000000ULL

struct queue_message {
    struct queue_message *next;
    int len;                        // bytes used in data
    uint8_t data[MESSAGE_DATA_MAX]; // VLQ message id, then the parameters
    uint64_t min_clock;             // MCU clock: not sent before it (a move queue slot comes free then); 0 = any time
    uint64_t req_clock;             // MCU clock: the MCU needs it by then; 0 = at once
    uint64_t notify_id;             // non-zero: notify the host when the MCU has acknowledged it
};

struct queue_message *message_alloc(void); // everything zero except `data`; aborts the program when memory is out
void message_free(struct queue_message *m);
void message_free_list(struct queue_message *list);

// Append one integer parameter in the wire's variable length form. Takes the value as the firmware declares it:
// signed ones sign-extended, unsigned ones zero-extended to 64 bits. Returns the byte after the last one written
// (1 to 5 bytes).
uint8_t *vlq_encode(uint8_t *p, int64_t value);

enum message_kind {
    MESSAGE_UNSIGNED = 'u', // modulo 2^32
    MESSAGE_SIGNED = 'i',   // the same, read as signed
    MESSAGE_BUFFER = 's',   // a length of one byte, then the bytes; value: position of the first << 8 | length
    // encoding knows these, too: a value beyond them is an error
    MESSAGE_BYTE = 'c',  // -128 .. 255
    MESSAGE_U16 = 'H',   // 0 .. 65535
    MESSAGE_I16 = 'h',   // -32768 .. 32767
};
enum { MESSAGE_CUT_NUMBER = -1, MESSAGE_CUT_BUFFER = -2 };

// The parameters of a message from `pos` on, one for each letter (enum message_kind) of `kinds`. Returns the position
// after them; MESSAGE_CUT_NUMBER, or MESSAGE_CUT_BUFFER less the parameter's number, where the message ends too soon.
int message_decode(const uint8_t *data, int len, int pos, const char *kinds, int64_t *values);

// The numbers of a message, one for each letter of `kinds`, to `out` (5 bytes a number at most). Returns the bytes
// written; -1 where a value is beyond its kind.
int message_encode(const char *kinds, const int64_t *values, uint8_t *out);

#endif
