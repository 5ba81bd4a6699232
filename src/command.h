/* Messages: how firmware code declares the commands it obeys and the responses it sends.
 *
 * Theory of operation.  A declaration stands beside its handler:
 *
 *     void command_set_lamp(const struct command_args *args) { lamp_write(args->val[0]); }
 *     DECL_COMMAND(command_set_lamp, "set_lamp value=%c");
 *
 *     DECL_RESPONSE(response_lamp, "lamp value=%c clock=%u");
 *     ... respond(&response_lamp, lamp_read(), timer_read_time());
 *
 * In a normal compile the macros shrink to declarations.  scripts/build/build_dictionary.py preprocesses every source
 * file once more with DICTIONARY_PASS defined, collects what the macros then leave in the text, and writes
 * OUT/compile_time.c: the command table, the encoders, the lists of init, task and shutdown functions, and the
 * compressed data dictionary the host fetches with `identify`.  A message's text is therefore written once.
 *
 * Formats: %c %hu %hi %u %i numbers (the width is documentation and, in responses, says how the argument is
 * passed), %*s or %.*s a byte string.  Commands may have one byte string and up to COMMAND_ARGS_MAX numbers.
 */
#ifndef COMMAND_H
#define COMMAND_H

#include <stdint.h>

enum { COMMAND_ARGS_MAX = 12, COMMAND_NO_BUFFER = 0xff };

/* What a handler is given.  val[i] is the i-th parameter that is not a byte string, in the order of the format;
 * negative numbers are the 32-bit pattern.  data points into the receive buffer: valid until the handler returns. */
struct command_args {
    uint32_t val[COMMAND_ARGS_MAX];
    const uint8_t *data;
    uint8_t data_len;
};

enum { HF_IN_SHUTDOWN = 1 << 0 };  /* the command is obeyed also while shut down */

struct command {
    void (*handler)(const struct command_args *args);
    uint8_t flags;
    uint8_t param_count;   /* numbers and byte string together */
    uint8_t buffer_param;  /* which of them is the byte string, or COMMAND_NO_BUFFER */
};

/* In flash, both the struct and the letters (flash_data.h).  types: one letter a parameter; u: %c %hu, s: %hi, w: %u %i, b: byte string */
struct response {
    int16_t id;
    const char *types;
};

#ifndef DICTIONARY_PASS
#define DECL_COMMAND(handler, format) void handler(const struct command_args *args)
#define DECL_COMMAND_FLAGS(handler, flags, format) void handler(const struct command_args *args)
#define DECL_RESPONSE(name, format) extern const struct response name
#define DECL_CONSTANT(name, value) struct dictionary_entry_unused
#define DECL_CONSTANT_STR(name, text) struct dictionary_entry_unused
#define DECL_ENUMERATION(enumeration, text, value) struct dictionary_entry_unused
#define DECL_ENUMERATION_RANGE(enumeration, text, first, count) struct dictionary_entry_unused
#define DECL_INIT(function) void function(void)
#define DECL_TASK(function) void function(void)
#define DECL_SHUTDOWN(function) void function(void)
#else
#define DECL_COMMAND(handler, format) DICT_ENTRY_COMMAND(handler, 0, format)
#define DECL_COMMAND_FLAGS(handler, flags, format) DICT_ENTRY_COMMAND(handler, flags, format)
#define DECL_RESPONSE(name, format) DICT_ENTRY_RESPONSE(name, format)
#define DECL_CONSTANT(name, value) DICT_ENTRY_CONSTANT(name, value)
#define DECL_CONSTANT_STR(name, text) DICT_ENTRY_CONSTANT_STR(name, text)
#define DECL_ENUMERATION(enumeration, text, value) DICT_ENTRY_ENUMERATION(enumeration, text, value, 1)
#define DECL_ENUMERATION_RANGE(enumeration, text, first, count) DICT_ENTRY_ENUMERATION(enumeration, text, first, count)
#define DECL_INIT(function) DICT_ENTRY_INIT(function)
#define DECL_TASK(function) DICT_ENTRY_TASK(function)
#define DECL_SHUTDOWN(function) DICT_ENTRY_SHUTDOWN(function)
#endif

/* DECL_INIT functions run once at boot, in the order of the source list.
 * Rule: a file that keeps static state brings ALL of it to its power-on value in its DECL_INIT function, because a
 * port may boot again in place (the simulator does; a test compares its memory).
 * DECL_TASK functions run in the main loop, interrupts enabled, and return quickly when they have nothing to do.
 * DECL_SHUTDOWN functions run with interrupts disabled, first thing after a shutdown; they must be safe to call
 * twice and must not call shutdown() or respond(). */

/* Send one message.  Call from commands and tasks only, never from a timer or an interrupt.  Arguments as the
 * format says: %c %hu %hi anything that promotes to int, %u %i exactly 32 bits wide (cast on 8-bit machines!),
 * a byte string as two arguments: (unsigned) length, const uint8_t *data.  A message that does not fit the
 * console's transmit buffer is dropped whole: responses are never retransmitted, the host asks again. */
void respond(const struct response *r, ...);

/* Any context: console_read() has something, run the command task soon. */
void command_wake(void);

/* Generated in OUT/compile_time.c; the tables lie in flash (flash_data.h). */
extern const struct command command_table[];  /* entry i is message id i + 1 */
extern const uint16_t command_count;
extern const uint8_t identify_data[];
extern const uint32_t identify_size;
void compile_time_init(void);
void compile_time_tasks(void);
void compile_time_shutdown(void);

#endif
