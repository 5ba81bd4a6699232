/* Objects, the move queue, and the commands every firmware has.
 *
 * Memory is handed out once and never freed: config commands (before finalize_config) take objects from the port's
 * arena, finalize_config turns what is left into the move queue.  There is no other dynamic memory.
 */
#ifndef BASECMD_H
#define BASECMD_H

#include <stdint.h>

/* Objects.  `type` is any address unique to the kind of object (its config handler, by custom): a command that names
 * an oid of another kind shuts down with "Invalid oid type" instead of reading foreign memory.
 * oid_alloc gives zeroed memory, only before finalize_config.  Task context. */
void *oid_alloc(uint8_t oid, void *type, uint16_t size);
void *oid_lookup(uint8_t oid, void *type);
/* Walk all objects of a kind: for (uint8_t i = 0; (o = oid_next(&i, type));) — or the macro.  Any context. */
void *oid_next(uint8_t *cursor, void *type);
#define foreach_oid(cursor, object, type) for ((cursor) = 0; ((object) = oid_next(&(cursor), (type)));)

/* Zeroed memory for life; only before finalize_config. */
void *alloc_chunk(uint16_t size);

/* The move queue: a pool of equal entries shared by everything that is scheduled ahead by the host.  The host knows its
 * size (config response) and counts.  An entry begins with a struct move_node; move_request_size() in a config command
 * makes entries at least that large.  After a shutdown is cleared all entries are free again: owners of queues forget
 * theirs with move_queue_init() in a DECL_SHUTDOWN function. */
struct move_node {
    struct move_node *next;
};
struct move_queue_head {
    struct move_node *first, **end;
};
void move_request_size(uint16_t size);
void *move_alloc(void);          /* any context; "Move queue overflow" when none is left */
void move_free(void *entry);     /* any context */

void move_queue_init(struct move_queue_head *q);
void move_queue_push(struct move_queue_head *q, struct move_node *node);      /* interrupts disabled */
struct move_node *move_queue_pop(struct move_queue_head *q);                  /* interrupts disabled; NULL if empty */
void move_queue_clear(struct move_queue_head *q);                             /* interrupts disabled; frees all */

static inline uint8_t
move_queue_empty(const struct move_queue_head *q)
{
    return !q->first;
}

#endif
